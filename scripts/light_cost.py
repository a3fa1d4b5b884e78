"""What lamps and their shadows cost a data set: CPU time of clips lit by lamps against the same casts in painted light.

python scripts/light_cost.py [--clips 6] [--size 256] [--rays 4]: one thread; the kinds take turns in one run.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch

from datagen.samples import make_sample
from datagen.scenes import Plan
from datagen.spec import parse_spec


def main() -> None:
    """Print a row a clip, and the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=6)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--rays", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    fields = {"width": chosen.size, "height": chosen.size, "rays_per_pixel": chosen.rays, "seed": chosen.seed}
    plans = {}
    for lighting in ("painted", "lamps"):
        plans[lighting] = Plan(parse_spec(fields | {"lighting": lighting}), (), "").to_json()
        make_sample(plans[lighting], 0)  # compiles
    print(f"{chosen.size} px, {chosen.rays} rays a pixel, torch {torch.__version__}, one thread, CPU time of a sample")
    print(f"{'clip':>4} {'painted':>9} {'lamps':>9} {'ratio':>6}  lit clip")
    ratios, totals = [], {"painted": 0.0, "lamps": 0.0}
    for clip in range(chosen.clips):
        spent = {}
        for lighting, plan in plans.items():
            start = time.process_time()
            sample = make_sample(plan, clip)
            spent[lighting] = time.process_time() - start
            totals[lighting] += spent[lighting]
        ratios.append(spent["lamps"] / spent["painted"])
        kinds = sample.meta["scene"]
        row = f"{clip:>4} {spent['painted']:>7.1f} s {spent['lamps']:>7.1f} s {ratios[-1]:>5.1f}x"
        print(f"{row}  {kinds['backdrop']}, camera {kinds['camera']}, {kinds['lamps']}", flush=True)
    whole = totals["lamps"] / totals["painted"]
    print(f"ratio of the sums {whole:.1f}x, median {statistics.median(ratios):.1f}x, most {max(ratios):.1f}x")


if __name__ == "__main__":
    main()
