"""A bench for studies: learning curves are trained once, then searched many times without training."""
