"""Optimisers and the linear algebra under them."""
