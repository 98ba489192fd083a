"""The layers of the models, as pure functions of (params, input, config).

Axis names in the shapes: `image` (position in a batch), `patch` (14 x 14 pixels, or 16 x 16),
`token` (class, registers, patches; or global and cluster tokens), `dim` (width of a token), `head`,
`cluster`, `descriptor`; `*batch` is any number of leading axes. Most functions take one image or a
batch; the cross-image encoder always has an explicit `image` axis.
"""
