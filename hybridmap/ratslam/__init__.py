"""RatSLAM as a system, for comparison: view cells, pose cells, and an experience map whose next node hangs on the match."""
