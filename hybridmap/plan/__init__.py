"""Going somewhere with a map: known free space, routes over the experience graph, and replay that keeps their values.

Everything here works on poses, edges and a grid, of a finished session or of a snapshot of a map that is being made.
"""
