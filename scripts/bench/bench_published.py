"""Measure images per second of published models, raced as in `bench_describe.py`.

    python scripts/bench/bench_published.py
        [--presets cosplace-resnet50 megaloc] [--batches 8] [--dtypes bfloat16]

It runs one model of each family, at the image size that it is published for.
"""

from bench_describe import cases, compare, read_race


def main() -> None:
    presets = ["cosplace-resnet50", "megaloc"]
    arguments = read_race(__doc__ or "", "bench_published", presets, [8])
    compare("bench_published", "Descriptors of a batch", cases(arguments), arguments)


if __name__ == "__main__":
    main()
