"""Signal processing: transforms, filters, blocks, rates, levels, ERB scale, spherical head."""
