"""Reports of a run: tables, curves, galleries of retrievals, and a web page of an evaluation."""

from crisalad_jax.experiments.report.charts import recall_curves as recall_curves
from crisalad_jax.experiments.report.charts import training_curves as training_curves
from crisalad_jax.experiments.report.gallery import show_retrievals as show_retrievals
from crisalad_jax.experiments.report.gallery import write_galleries as write_galleries
from crisalad_jax.experiments.report.inside import show_attention as show_attention
from crisalad_jax.experiments.report.inside import show_descriptors as show_descriptors
from crisalad_jax.experiments.report.inside import show_gradient_norms as show_gradient_norms
from crisalad_jax.experiments.report.inside import show_image_attention as show_image_attention
from crisalad_jax.experiments.report.page import write_report as write_report
from crisalad_jax.experiments.report.style import save as save
from crisalad_jax.experiments.report.style import save_chart as save_chart
from crisalad_jax.experiments.report.transport import show_transport as show_transport
from crisalad_jax.experiments.tables import RecallRow as RecallRow
from crisalad_jax.experiments.tables import recall_table as recall_table
