"""The layers, as pure functions of (params, input, config).

Axis names in the shapes: `image` (position in a batch), `patch` (14 x 14 pixels, or 16 x 16),
`token` (class, registers, patches; or global and cluster tokens), `dim` (width of a token), `head`,
`cluster`, `descriptor`. Functions act on one image; `nn.model` maps them over a batch. The
exception is the cross-image encoder, whose image axis is explicit.
"""
