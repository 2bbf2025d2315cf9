# SPDX-License-Identifier: GPL-3.0-or-later
"""Attacks every command with failing and fatal file operations: `python tests/faults/attack.py --faults 200 --kills
100`.

Each attempt runs a command with one fault, looks at what it left, and runs it again without a fault. What has to hold:
the command ends; it reports a failure in a sentence, or its result is that of an unbroken run; no file under a final
name is cut short; the second run succeeds, gives the unbroken result and leaves nothing hidden behind. Files that
differ between two unbroken runs (logs with times) are checked for being whole only. Prints a table by command; the exit
status is 1 where anything failed.
"""
from __future__ import annotations

import argparse
import importlib
import importlib.util
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT)]

from tests.faults import injection  # noqa: E402
from tests.faults.injection import CALLS, ERRORS, Fault, Injector, Outcome  # noqa: E402

if injection.is_preloaded():  # before the modules of the program
    _spec = importlib.util.spec_from_file_location("fit_flare_run", ROOT / "headless" / "run.py")
    assert _spec is not None
    assert _spec.loader is not None
    _run = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(_run)
    _run.register_package()
    importlib.import_module("fit_flare.headless.cli")

from tests.faults.cases import Case, Inputs, Snapshot, cases, fit_argv, leftovers, snapshot, why_not_whole  # noqa: E402

UNBROKEN = Fault("none", 0)
WARM = ("core.fit.run_loop", "core.bake.bake", "core.transfer.transfer", "core.transfer.export",
        "core.removal.jobs.batch", "core.removal.jobs.fitted", "core.metrics.evaluation", "core.capture.solve",
        "headless.targets")
"""Modules that are loaded once, before the forks."""
STAYS_HIDDEN = (".solve", ".held")
"""Hidden files that are kept on purpose: the work of a solve; an empty lock file that could not be removed, which the
next process locks again."""


def make_inputs(folder: Path, injector: Injector) -> Inputs:
    """Make what the commands read: a capture, a run and its layers, weights, and frames to solve."""
    from tests.core.captures import orbit
    from tests.core.flared import flared_capture
    from tests.core.removal_cases import network_file
    from tests.core.test_solve import SIZE, shoot

    inputs = Inputs(flared_capture(folder / "capture", count=7, dots=60), folder / "run", folder / "layers",
                    network_file(folder / "weights.safetensors", bias=0.2),
                    shoot(folder / "shot", orbit(8, size=SIZE, arc=0.7)))
    for argv in (fit_argv(inputs.capture, inputs.run),
                 ["bake", str(inputs.run), "--out", str(inputs.layers), "--frames", "1-3"]):
        done = injector.run(argv, folder, UNBROKEN, 600)
        if done.status:
            raise RuntimeError(done.text)
    return inputs


class Attack:
    """The attempts on one command, below `folder`."""

    def __init__(self, case: Case, folder: Path, injector: Injector) -> None:
        self.case, self._folder, self._injector = case, folder, injector
        self.out = folder / "out"
        first, _ = self._unbroken()
        second, outcome = self._unbroken()
        self._calls = outcome.counts
        self.reference: Snapshot = second
        self.varying = {name for name in second if first.get(name) != second[name]}
        if first.keys() != second.keys():
            raise RuntimeError(f"{case.name} writes other files each time")
        self.failures: list[str] = []
        self.counts: Counter[str] = Counter()

    def faults(self, number: int, kill: bool) -> list[Fault]:
        """Spread `number` faults over the calls that an unbroken run makes."""
        totals = self._calls
        used = [call for call in CALLS if totals[call]]
        if not used:
            return []
        faults = []
        for index in range(number):
            call = used[index % len(used)]
            turn, turns = index // len(used), -(-number // len(used))
            at = 1 + turn * (totals[call] - 1) // max(turns - 1, 1)
            error = "kill" if kill else ERRORS[index // len(used) % len(ERRORS)]
            faults.append(Fault(call, at, error, sticky=error == "ENOSPC" and call == "write" and turn % 2 == 1))
        return faults

    def try_one(self, fault: Fault) -> None:
        """Run with the fault, then without; note what does not hold."""
        self.counts["kills" if fault.error == "kill" else "faults"] += 1
        self._reset()
        argv = self.case.argv(self.out)
        try:
            outcome = self._injector.run(argv, self.out, fault)
        except TimeoutError as problem:
            self._fail(fault, str(problem))
            return
        self._check_broken(fault, outcome)
        try:
            again = self._injector.run(argv, self.out, UNBROKEN)
        except TimeoutError as problem:
            self._fail(fault, f"the second run: {problem}")
            return
        if again.status:
            self._fail(fault, f"the second run ends with {again.status}: {again.text[-600:]}")
            return
        self._compare(fault, "the second run")
        left = [name for name in leftovers(self.out) if not any(part in name for part in STAYS_HIDDEN)]
        if left:
            self._fail(fault, f"the second run leaves {left}")

    def _check_broken(self, fault: Fault, outcome: Outcome) -> None:
        killed = fault.error == "kill"
        if outcome.status == 0:
            self.counts["harmless"] += 1
            self._compare(fault, "success told")
        elif killed and outcome.status == -9:
            self.counts["killed"] += 1
        elif outcome.status in (1, 2):
            self.counts["refused in a sentence"] += 1
            if "Traceback" in outcome.text or "defect of Fit Flare" in outcome.text or "error:" not in outcome.text:
                self._fail(fault, f"no sentence: {outcome.text[-1200:]}")
        else:
            self._fail(fault, f"status {outcome.status}: {outcome.text[-600:]}")
        for name in snapshot(self.out):
            reason = why_not_whole(self.out / name)
            if reason:
                self._fail(fault, f"{name} is not whole: {reason}")

    def _compare(self, fault: Fault, what: str) -> None:
        now = snapshot(self.out)
        other = [name for name in sorted({*now, *self.reference} - self.varying)
                 if now.get(name) != self.reference.get(name)] + [name for name in self.varying if name not in now]
        if other:
            self._fail(fault, f"{what}, but other than unbroken: {other[:6]}")

    def _fail(self, fault: Fault, text: str) -> None:
        self.failures.append(f"{self.case.name}, {fault}: {text}")
        print(f"FAILED {self.failures[-1]}", flush=True)

    def _reset(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir(parents=True)
        self.case.prepare(self.out)

    def _unbroken(self) -> tuple[Snapshot, Outcome]:
        self._reset()
        outcome = self._injector.run(self.case.argv(self.out), self.out, UNBROKEN, 600)
        if outcome.status:
            raise RuntimeError(f"{self.case.name}: {outcome.text[-2000:]}")
        return snapshot(self.out), outcome


def attack(folder: Path, faults: int, kills: int, only: list[str], limit_s: float) -> int:
    """Attack the commands in a preloaded process, for at most `limit_s`; return the exit status."""
    import torch

    end = time.monotonic() + limit_s

    torch.set_num_threads(1)
    for name in WARM:
        importlib.import_module(f"fit_flare.{name}")
    injector = Injector(folder / "log")
    inputs = make_inputs(folder / "inputs", injector)
    chosen = [case for case in cases(inputs) if not only or case.name in only]
    attacks: list[Attack] = []
    for case in chosen:
        try:
            attacks.append(Attack(case, folder / case.name.replace(" ", "_"), injector))
            print(f"{case.name}: {len(attacks[-1].reference)} files", flush=True)
        except (RuntimeError, TimeoutError) as problem:
            print(f"FAILED {case.name} without a fault: {problem}", flush=True)
    planned = []
    for one in attacks:
        part = one.case.weight / sum(other.case.weight for other in attacks)
        plan = [*one.faults(round(faults * part), kill=False), *one.faults(round(kills * part), kill=True)]
        # In turn over all commands, so that an attack that is cut off has been on each.
        planned += [((index + 0.5) / len(plan), one, fault) for index, fault in enumerate(_shuffled(plan))]
    for _, one, fault in sorted(planned, key=lambda entry: entry[0]):
        if time.monotonic() > end:
            print("The time is over.")
            break
        one.try_one(fault)
    _print_table(attacks)
    return int(len(attacks) < len(chosen) or any(one.failures for one in attacks))


def _shuffled(plan: list[Fault]) -> list[Fault]:
    """Return the plan in an order that is the same each time."""
    return random.Random(0).sample(plan, len(plan))


def _print_table(attacks: list[Attack]) -> None:
    columns = ("faults", "kills", "refused in a sentence", "harmless", "killed")
    print(f"| command | {' | '.join(columns)} | failed | files that vary |\n|{' --- |' * (len(columns) + 3)}")
    total: Counter[str] = Counter()
    for one in attacks:
        total += Counter({**one.counts, "failed": len(one.failures)})
        print(f"| {one.case.name} | {' | '.join(str(one.counts[name]) for name in columns)} | {len(one.failures)} | "
              f"{', '.join(sorted(one.varying))} |")
    print(f"| all | {' | '.join(str(total[name]) for name in columns)} | {total['failed']} | |", flush=True)


def main(argv: list[str]) -> int:
    """Start the attack in a preloaded process, or carry it out there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--only", nargs="*", default=[], help="names of commands")
    parser.add_argument("--minutes", type=float, default=600.0, help="time after which it ends")
    parser.add_argument("--folder", type=Path, help="folder for the work, which is kept")
    args = parser.parse_args(argv)
    if not injection.is_preloaded():
        if reason := injection.reason_to_skip():
            print(reason)
            return 1
        with tempfile.TemporaryDirectory(prefix="attack-") as made:
            folder = args.folder or Path(made)
            folder.mkdir(parents=True, exist_ok=True)
            return injection.start_preloaded(Path(__file__), [*argv, "--folder", str(folder)], folder)
    return attack(args.folder, args.faults, args.kills, args.only, 60 * args.minutes)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
