"""Competing methods on the same points and frames: tables, figures, goals."""

from fitting.study.compare import Goal, Study, run_study

__all__ = ["Goal", "Study", "run_study"]
