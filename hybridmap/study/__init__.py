"""Studies: sources x front-end settings x back-ends x false loops x seeds, resumable, on one machine or a cluster."""

from hybridmap.study.model import StudyConfig, named_studies

__all__ = ["StudyConfig", "named_studies"]
