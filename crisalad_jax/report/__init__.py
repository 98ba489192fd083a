"""What a run shows: tables, curves, galleries of predictions, and a page of an evaluation."""

from crisalad_jax.report.curves import PrecisionCurve, recall_curves, training_curves
from crisalad_jax.report.gallery import prediction_gallery
from crisalad_jax.report.page import write_report
from crisalad_jax.report.tables import RecallRow, recall_markdown, recall_table

__all__ = [
    "PrecisionCurve",
    "RecallRow",
    "prediction_gallery",
    "recall_curves",
    "recall_markdown",
    "recall_table",
    "training_curves",
    "write_report",
]
