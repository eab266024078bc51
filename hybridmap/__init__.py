"""A factor-graph hybrid mapper: neural path integration, scanline loop closure, relaxation and GTSAM on one graph."""
