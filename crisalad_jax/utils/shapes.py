"""Types of NumPy arrays with their shapes, for annotations in modules that run without JAX.

To a type checker they are jaxtyping's. At run time they are plain NumPy arrays. jaxtyping is not
imported, because the import would slow down `query` with a runtime other than JAX.
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
