"""Reports of a run: tables, curves, galleries of predictions, and a page of an evaluation."""

from crisalad_jax.experiments.report.curves import PrecisionCurve, recall_curves, training_curves
from crisalad_jax.experiments.report.gallery import (
    answers_gallery,
    prediction_gallery,
    write_galleries,
)
from crisalad_jax.experiments.report.page import write_report
from crisalad_jax.experiments.report.tables import RecallRow, recall_markdown, recall_table

__all__ = [
    "PrecisionCurve",
    "RecallRow",
    "answers_gallery",
    "prediction_gallery",
    "recall_curves",
    "recall_markdown",
    "recall_table",
    "training_curves",
    "write_galleries",
    "write_report",
]
