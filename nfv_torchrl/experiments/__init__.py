"""The paper's experiments: cells that are computed once, and the figures made of them."""
