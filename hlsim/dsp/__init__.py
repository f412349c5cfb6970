"""Signal code that knows nothing of hearing: transforms, filters, blocks, rates, levels."""
