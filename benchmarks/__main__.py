"""``python -m benchmarks NAME [--quick] [--output DIR]``."""

import argparse
import importlib
import sys
from pathlib import Path

# Imported when asked for: each has its own needs.
BENCHMARKS = {
    "accuracy": "error against human thresholds, and what it costs in time; 20 minutes, "
    "30 seconds with --quick",
    "calibrate": "fit the observer to human thresholds; 15 minutes, 1 with --quick",
    "denoisers": "what Open Image Denoise and others leave visible; 15 minutes, 30 seconds with "
    "--quick",
    "effects": "what each effect costs, of the metric and of light, and what leaving it out shows; "
    "20 minutes, 30 seconds with --quick",
    "evaluate": "what many frames cost beside the metric, and what they hold; 20 minutes, "
    "1 with --quick",
    "gpu": "time, memory and equality on a CUDA device; 10 minutes, 15 seconds with --quick",
    "large": "memory on images up to 16,384 x 16,384; 15 minutes, 15 seconds with --quick",
    "launches": "how many operations a map is, which a GPU waits for; 1 minute, 5 seconds with "
    "--quick",
    "oracle": "the fewest samples that placement could need; 15 minutes, 10 seconds with --quick",
    "overhead": "what deciding costs beside rendering; 10 minutes, 10 seconds with --quick",
    "paper": "Figures 9 to 14, and real scenes; 2 hours, 30 seconds with --quick",
    "people": "what people saw of noise, masks, quantisation; 5 minutes, 30 seconds with --quick",
    "pictures": "what each transform says of pictures; 1 minute, 10 seconds with --quick",
    "speed": "time and memory beside kornia's SSIM; 6 minutes, 1 with --quick",
    "stability": "hard images in every precision; 10 minutes, 15 seconds with --quick",
    "stopping": "whether the sampler stops honestly; 30 minutes, 10 seconds with --quick",
    "tiles": "what skipping untouched tiles saves; 1 minute, 10 seconds with --quick",
    "training": "a denoiser trained with each loss; 30 minutes, 30 seconds with --quick",
}

# Those that come in parts.
PARTS = {"accuracy": ("errors", "times"), "effects": ("metric", "renderer")}


def _parts() -> str:
    return "; ".join(f"of {name}: {', '.join(parts)}" for name, parts in PARTS.items())


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure, and write a JSON, a table in Markdown and a plot.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"  {name}: {what}" for name, what in BENCHMARKS.items()),
    )
    parser.add_argument("name", choices=tuple(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="small sizes, few runs: a smoke test")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="where to write; without it, benchmarks/results, and with --quick nothing is written",
    )
    parser.add_argument("--part", help=f"measure this and keep the rest: {_parts()}")
    options = parser.parse_args()
    if options.part is not None and options.part not in PARTS.get(options.name, ()):
        parser.error(f"expected a part that there is, {_parts()}, got {options.part!r}")
    output = options.output
    if output is None and not options.quick:
        output = Path(__file__).parent / "results"
    more = {} if options.part is None else {"part": options.part}
    importlib.import_module(f"benchmarks.{options.name}").run(options.quick, output, **more)
    return 0


if __name__ == "__main__":
    sys.exit(main())
