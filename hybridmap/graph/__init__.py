"""The map as nodes and edges: experience map, pose graph, files, paths, and agreement of loops."""
