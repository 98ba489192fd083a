"""CriSALAD in torch: plain modules to read alongside `crisalad_jax.nn`, under the public names.

Files, classes and the order of lines follow `crisalad_jax`; the arithmetic is torch's wherever
possible (`F.interpolate`, `F.layer_norm`, `F.conv2d`, `F.normalize`, autograd, AdamW). Arrays are
batch first, and pixels and features channels first. The names in the state dict are those of
DINOv2, SALAD, CricaVPR and `torch.nn.TransformerEncoder`: a public checkpoint only needs renamed
prefixes.
"""
