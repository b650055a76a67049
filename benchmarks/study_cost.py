"""
Cost of a study beside its runs: 1,000 runs of an agent that does nothing on a task that does nothing.

    python benchmarks/study_cost.py [--runs 1000] [--workers 1] [--folder DIR]

Imports are measured apart: the process that makes the runs is started once and stays. Going on with a study whose runs
are all done is measured too. Leave the machine alone meanwhile; the folder must be on the disk that is asked about.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from sb3_sample import study
from sb3_sample.study.plan import Plan, Run
from sb3_sample.study.worker import serve


def make_nothing(run: Run, folder: Path, options: list[str]) -> None:
    """Make a run of nothing: its folder, and in it the time at which it was made."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "made.txt").write_text(str(time.time()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where a folder is made, and removed afterwards")
    args = parser.parse_args()
    runs = tuple(Run("Nothing", "nothing", {}, {}, "nothing-v0", seed, 1) for seed in range(args.runs))
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        worker = (sys.executable, __file__, "--serve")
        start = time.time()
        found = study.run(Plan("nothing", runs), folder, workers=args.workers, worker=worker)
        end = time.time()
        assert found.counts["done"] == args.runs
        # From the first run of the process on: what comes before are its imports.
        first = min(float(path.read_text()) for path in Path(folder).glob("runs/**/made.txt"))
        again = time.time()
        study.run(Plan("nothing", runs), folder, workers=args.workers, worker=worker)
        going_on = time.time() - again
        again = time.time()
        study.status(folder)
        status = time.time() - again
    print("| runs | processes | until the first run (s) | a run (ms) | all done, again (s) | status (s) |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    milliseconds = (end - first) / max(args.runs - 1, 1) * 1000
    print(
        f"| {args.runs:,} | {args.workers} | {first - start:.1f} | {milliseconds:.2f} | {going_on:.2f} | {status:.2f} |"
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        del sys.argv[1]
        serve(make_nothing)
    else:
        main()
