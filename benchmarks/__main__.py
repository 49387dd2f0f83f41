"""All benchmarks, one after another, each in a process of its own, with a summary at the end.

    python benchmarks [--quick] [NAME …]

Each can also be run by itself; ``python benchmarks/NAME.py --help`` tells with what options.  What
they mean stands in docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
#: Those that take ``--clock``, the quick ones first.  Any other file here is a benchmark too, but
#: for builds.py, which needs another checkout to compare with.
CLOCKED = (
    "kernel", "budget", "tail", "growth", "searchers", "reoptimise", "closed_loop", "gap",
    "admission", "pushes", "environments",
)  # fmt: skip
HELPERS = ("__main__", "builds", "harness", "rivals", "predictive", "acados_server", "entrants")
OTHERS = sorted(path.stem for path in HERE.glob("*.py") if path.stem not in (*CLOCKED, *HELPERS))
NAMES = (*CLOCKED, *OTHERS)


def main() -> int:
    """Run them and gather their findings."""
    parser = argparse.ArgumentParser(
        prog="python benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="examples:\n  python benchmarks\n  python benchmarks --quick\n"
        "  python benchmarks kernel tail --clock cpu",
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"which; all by default: {', '.join(NAMES)}"
    )
    parser.add_argument("--quick", action="store_true", help="less of everything: does it run?")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall",
                        help="cpu: for a machine that others use as well")  # fmt: skip
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in NAMES]
    if unknown:
        parser.error(f"no benchmark named {', '.join(unknown)}; there are {', '.join(NAMES)}")
    findings, failed = [], []
    for name in options.names or NAMES:
        print(f"\n=== {name}", flush=True)
        command = [sys.executable, str(HERE / f"{name}.py")]
        command += ["--quick"] * options.quick
        if name in CLOCKED:
            command += ["--clock", options.clock]
        began, lines = time.perf_counter(), []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None  # it was asked for
            for line in process.stdout:
                print(line, end="", flush=True)
                lines.append(line.strip())
        minutes = (time.perf_counter() - began) / 60
        print(f"\n({minutes:.1f} min)", flush=True)
        if process.returncode:
            failed.append(name)
        findings += [f"{name}: {line}" for line in lines if "(wanted" in line]
    print("\n=== summary")
    for finding in findings:
        print(finding)
    if failed:
        print(f"failed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
