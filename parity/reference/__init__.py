"""CriSALAD in torch: plain modules to be read beside `crisalad_jax.nn`, under the public names.

Files, classes and the order of the lines follow `crisalad_jax`; the arithmetic is torch's wherever
torch has it (`F.interpolate`, `F.layer_norm`, `F.conv2d`, `F.normalize`, autograd, AdamW). Shapes
carry the batch in front, pixels and features channels first. The state dict's names are those of
DINOv2, SALAD, CricaVPR and `torch.nn.TransformerEncoder`: a public checkpoint is a renamed prefix.
"""
