"""What a run shows: recall tables, recall and training curves, galleries of predictions."""

from crisalad_jax.report.curves import recall_curves, training_curves
from crisalad_jax.report.gallery import prediction_gallery
from crisalad_jax.report.tables import RecallRow, recall_markdown, recall_table

__all__ = [
    "RecallRow",
    "prediction_gallery",
    "recall_curves",
    "recall_markdown",
    "recall_table",
    "training_curves",
]
