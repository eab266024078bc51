"""Relaxation rules: the paper's, its stable variant, and RatSLAM's."""
