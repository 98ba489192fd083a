"""XLA options that choose the library for matrix products on a CPU, in jax 0.10 and 0.12."""

_FUSIONS = "xla_cpu_experimental_ynn_fusion_type"
LIBRARIES: dict[str, dict[str, bool | str]] = {
    "Eigen": {_FUSIONS: ""},
    "Eigen, sums by YNN": {_FUSIONS: "LIBRARY_FUSION_TYPE_REDUCE"},
    # Its programs cannot be stored in the compile cache.
    "oneDNN": {
        _FUSIONS: "",
        "xla_cpu_use_onednn": True,
        "xla_cpu_experimental_onednn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT",
    },
    # Single products, whereas jaxlib's defaults also give YNN whole attentions.
    "YNN": {_FUSIONS: "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"},
}
