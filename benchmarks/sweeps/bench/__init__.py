"""A bench for studies: learning curves that are trained once, and searched many times without training."""
