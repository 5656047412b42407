"""Commands around the library: the bench, sweeps and the paper's figures."""
