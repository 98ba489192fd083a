"""Types of NumPy arrays with their shapes, for the annotations of modules that run without JAX.

To who checks types they are jaxtyping's. A program sees NumPy's arrays alone, and does not import
jaxtyping, which `query` with another runtime would wait for.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Float32 as Float32
    from jaxtyping import Float64 as Float64
    from jaxtyping import Int as Int
    from jaxtyping import Int32 as Int32
    from jaxtyping import Int64 as Int64
    from jaxtyping import UInt8 as UInt8
    from jaxtyping import UInt16 as UInt16
else:

    class _Shaped:
        def __class_getitem__(cls, array_and_shape: tuple[Any, str]) -> Any:
            """Return the array's type, which is what `TYPE[array, shape]` is at run time."""
            return array_and_shape[0]

    Bool = Float = Float32 = Float64 = Int = Int32 = Int64 = UInt8 = UInt16 = _Shaped
