"""Convert traced programs to ONNX, with one small function for each JAX primitive.

`convert` walks through a program, `graph` holds the nodes, and `operators` has the functions.
Operations with constant inputs are folded, so that loops over layers become plain nodes.
"""
