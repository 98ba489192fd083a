"""Compare one layer with torch: the cross-image encoder's is `nn.TransformerEncoderLayer`.

Weights are copied, then outputs and all gradients are compared. Torch stores the weight of a linear
layer transposed. `parity/` does this for the whole model. It needs torch: `pip install torch`.

    python examples/parity_layer.py
"""

import jax
import numpy as np
import torch

import crisalad_jax as cj

NAMES = {
    "attn.qkv.weight": "self_attn.in_proj_weight",
    "attn.qkv.bias": "self_attn.in_proj_bias",
    "attn.proj": "self_attn.out_proj",
}
"""Torch's names by ours; all other names are the same."""


def to_torch(tree):
    """Return the arrays of a layer by torch's names, in torch's layout."""
    arrays = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        for ours, theirs in NAMES.items():
            name = name.replace(ours, theirs)
        arrays[name] = torch.tensor(np.asarray(leaf).T)
    return arrays


def main():
    """Print the largest difference of the outputs, and of each gradient of a sum of squares."""
    config = cj.CrossImageConfig(layers=1, heads=4, feedforward=64, dropout=0.0)
    params = config.init(jax.random.key(0), 32)
    tokens = jax.random.normal(jax.random.key(1), (6, 5, 32))  # images, tokens, width

    theirs = torch.nn.TransformerEncoderLayer(32, 4, 64, dropout=0.0, activation="gelu")
    theirs.load_state_dict(to_torch(params.layers[0]))
    target = jax.random.normal(jax.random.key(2), tokens.shape)

    def loss(params):
        output = config.apply(params, tokens, mask=None, key=None)
        return ((output - target) ** 2).sum(), output

    (_, output), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    expected = theirs(torch.tensor(np.asarray(tokens)))  # attends along the first axis, as ours
    ((expected - torch.tensor(np.asarray(target))) ** 2).sum().backward()

    pairs = {"output": (torch.tensor(np.asarray(output)), expected.detach())}
    ours = to_torch(gradient.layers[0])
    pairs |= {name: (ours[name], each.grad) for name, each in theirs.named_parameters()}
    differences = {
        name: float((a - b).abs().max() / b.abs().max()) for name, (a, b) in pairs.items()
    }
    for name, difference in differences.items():
        print(f"{name:<28}{difference:.1e}")
    return differences


if __name__ == "__main__":
    main()
