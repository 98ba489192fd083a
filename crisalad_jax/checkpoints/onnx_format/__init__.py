"""Convert traced programs to ONNX, with one small function for each JAX primitive.

`convert` walks through a program, `graph` holds the nodes, and `operators` has the functions.
Operations on constants are computed during the conversion, and loops over layers are unrolled.
"""
