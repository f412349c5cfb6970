"""Signal processing that is independent of hearing: transforms, filters, blocks, rates, levels."""
