"""End-to-end experiments: training, adaptation, distillation, comparisons, reports, the demo."""
