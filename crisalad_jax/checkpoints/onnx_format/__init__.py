"""Convert traced programs to ONNX: one small function for each primitive of JAX.

`convert` walks through a program, `graph` holds the nodes, and the other modules are the functions.
What has constant inputs is computed at once, so that loops over layers become plain nodes.
"""
