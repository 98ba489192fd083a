"""Reports of a run: tables, curves, galleries of predictions, and a page of an evaluation."""

from crisalad_jax.experiments.report.charts import recall_curves, training_curves
from crisalad_jax.experiments.report.gallery import show_retrievals, write_galleries
from crisalad_jax.experiments.report.page import write_report
from crisalad_jax.experiments.report.style import save
from crisalad_jax.experiments.report.tables import RecallRow, recall_table
from crisalad_jax.experiments.report.transport import show_transport

__all__ = [
    "RecallRow",
    "recall_curves",
    "recall_table",
    "save",
    "show_retrievals",
    "show_transport",
    "training_curves",
    "write_galleries",
    "write_report",
]
