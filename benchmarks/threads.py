"""
Threads and the time of a gradient step, on an idle machine and beside a busy process.

    python benchmarks/threads.py [--threads 1 2] [--agent SAC] [--seconds 3]

Each setting runs in a process of its own, since OpenMP reads its environment once. "busy" means that another process
computes on one core meanwhile. ``OMP_WAIT_POLICY=passive`` lets threads that wait sleep instead of spin.
"""

import argparse
import os
import subprocess
import sys

MEASURE = """
import statistics, sys, time, warnings
sys.path.insert(0, sys.argv[1])
warnings.simplefilter("ignore")
import sb3_sample
from update_speed import build, training_step

agent, compiled, seconds = sys.argv[2], sys.argv[3] == "True", float(sys.argv[4])
model = build(getattr(sb3_sample, agent), compile=compiled)
step = training_step(model, model.batch_size)
for _ in range(5):
    step()
times, end = [], time.perf_counter() + seconds
while time.perf_counter() < end:
    start = time.perf_counter()
    step()
    times.append(time.perf_counter() - start)
print(1e3 * statistics.mean(times))
"""
BUSY = "while True: pass"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, os.cpu_count() or 1])
    parser.add_argument("--agent", default="SAC")
    parser.add_argument("--seconds", type=float, default=3.0, help="of measuring, a setting")
    args = parser.parse_args()
    here = os.path.dirname(os.path.abspath(__file__))
    print(f"{args.agent}, ms a gradient step (mean)\n")
    print(f"{'threads':>8}{'wait policy':>13}{'':>10}{'idle':>10}{'busy':>10}{'busy/idle':>11}")
    for compiled in (False, True):
        for threads in args.threads:
            for policy in ("default",) if threads == 1 else ("default", "passive"):
                environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
                environment.pop("OMP_WAIT_POLICY", None)
                if policy != "default":
                    environment["OMP_WAIT_POLICY"] = policy
                command = [sys.executable, "-c", MEASURE, here, args.agent, str(compiled), str(args.seconds)]
                figures = []
                for busy in (False, True):
                    other = subprocess.Popen([sys.executable, "-c", BUSY]) if busy else None
                    try:
                        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
                    finally:
                        if other is not None:
                            other.kill()
                            other.wait()
                    figures.append(float(done.stdout.split()[-1]))
                idle, beside = figures
                how = "compiled" if compiled else "eager"
                print(f"{threads:8}{policy:>13}{how:>10}{idle:10.2f}{beside:10.2f}{beside / idle:11.2f}", flush=True)


if __name__ == "__main__":
    main()
