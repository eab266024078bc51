"""Every table and figure of the paper beside what comes of it here (`hybridmap reproduce`).

`paper` is the one list of what the paper has, and says of each item whether it is done, done differently or missing.
"""
