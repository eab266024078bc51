"""Maps of many sessions: one is taken up again, another is joined to it, and what was joined can be parted."""
