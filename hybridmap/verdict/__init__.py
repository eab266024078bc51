"""The verdict on a finished map: trusted, doubtful or failed, with the reasons.

Each rule is one function from the facts of a finished drive to reasons against its map. A map is trusted if no rule finds a
reason. No rule needs a ground truth.
"""

from hybridmap.verdict.facts import Facts
from hybridmap.verdict.reasons import KINDS, Kind, Reason, Verdict, said_of, verdict_of
from hybridmap.verdict.rules import RULES, reasons_of

__all__ = ["KINDS", "RULES", "Facts", "Kind", "Reason", "Verdict", "reasons_of", "said_of", "verdict_of"]
