"""Thousands of structured inputs: ``make fuzz``, or

    python test/fuzz/run.py [--inputs 5400] [--first-seed 1000] [--only mcap]

Every input is made from a seed, so a finding is repeated by its format and seed. A worker process
does them one after the other; one that takes too long, too much memory, or ends, is a finding.
Prints a table; exit code 1 if anything was found.
"""

import argparse
import json
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

LONGEST_S, LARGEST_MB = 10.0, 1000.0
# A worker is ended after so many seconds of silence, on a machine that may be busy.
SILENCE_S = 120.0
INPUTS_PER_WORKER = 50


def work(name, seeds, folder):
    """Do inputs, and print a line of JSON about each."""
    from fuzz.inputs import Finding, exercise

    for seed in seeds:
        print(json.dumps({"begins": seed}), flush=True)
        started, finding, code = time.process_time(), "", None
        try:
            code = exercise(name, seed, folder)
        except Finding as error:
            finding = f"finding: {error}"
        except BaseException as error:
            finding = f"{type(error).__name__}: {error}"[:300]
        memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        line = {"seed": seed, "code": code, "seconds": time.process_time() - started}
        print(json.dumps(line | {"memory_mb": memory_mb, "finding": finding}), flush=True)


def limited():
    """Memory of a worker; what goes beyond it is a finding."""
    resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))


def run_worker(name, seeds, folder):
    """Outcomes of inputs in a process of its own, and the seeds that it did not come to."""
    options = ["--work", name, "--seeds", *map(str, seeds), "--folder", str(folder)]
    process = subprocess.Popen(
        [sys.executable, __file__, *options], stdout=subprocess.PIPE, text=True, preexec_fn=limited
    )
    outcomes, current = [], None
    while True:
        ready, _, _ = select.select([process.stdout], [], [], SILENCE_S)
        line = process.stdout.readline() if ready else ""
        if not line:
            break
        said = json.loads(line)
        if "begins" in said:
            current = said["begins"]
        else:
            outcomes.append(said)
            current = None
    process.kill()
    process.wait()
    if current is not None:
        finding = "no end" if not ready else f"the process ended with {process.returncode}"
        outcomes.append({"seed": current, "code": None, "seconds": SILENCE_S, "memory_mb": 0.0,
                         "finding": finding})  # fmt: skip
    done = {outcome["seed"] for outcome in outcomes}
    return outcomes, [seed for seed in seeds if seed not in done]


def fuzz(name, seeds, folder):
    """Outcomes of all seeds of a format."""
    outcomes, seeds = [], list(seeds)
    while seeds:
        found, rest = run_worker(name, seeds[:INPUTS_PER_WORKER], folder)
        outcomes += found
        seeds = rest + seeds[INPUTS_PER_WORKER:]
        shutil.rmtree(folder)
        folder.mkdir()
    for outcome in outcomes:
        if not outcome["finding"] and outcome["seconds"] > LONGEST_S:
            outcome["finding"] = f"took {outcome['seconds']:.1f} s"
        if not outcome["finding"] and outcome["memory_mb"] > LARGEST_MB:
            outcome["finding"] = f"took {outcome['memory_mb']:.0f} MB"
    return outcomes


def main():
    """Run all formats and print the table; returns the exit code."""
    from fuzz.inputs import FORMATS

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--inputs", type=int, default=5400)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--only", choices=FORMATS)
    parser.add_argument("--work", choices=FORMATS, help=argparse.SUPPRESS)
    parser.add_argument("--seeds", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.work, arguments.seeds, arguments.folder)
        return 0
    names = [arguments.only] if arguments.only else list(FORMATS)
    count = -(-arguments.inputs // len(names))
    seeds = range(arguments.first_seed, arguments.first_seed + count)
    n_findings = 0
    print(f"{'format':12s} inputs  read  refused  longest s  largest MB  findings")
    with tempfile.TemporaryDirectory() as temporary:
        for name in names:
            folder = Path(temporary, "cases")
            folder.mkdir(exist_ok=True)
            outcomes = fuzz(name, seeds, folder)
            codes = Counter(outcome["code"] in (0, 3) for outcome in outcomes)
            findings = [outcome for outcome in outcomes if outcome["finding"]]
            n_findings += len(findings)
            longest = max(outcome["seconds"] for outcome in outcomes)
            largest = max(outcome["memory_mb"] for outcome in outcomes)
            print(f"{name:12s} {len(outcomes):6d} {codes[True]:5d} {codes[False]:8d} "
                  f"{longest:10.2f} {largest:11.0f} {len(findings):9d}", flush=True)  # fmt: skip
            for outcome in findings[:20]:
                print(f"  {name} {outcome['seed']}: {outcome['finding']}", flush=True)
    return 1 if n_findings else 0


if __name__ == "__main__":
    sys.exit(main())
