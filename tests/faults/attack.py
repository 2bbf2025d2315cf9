# SPDX-License-Identifier: GPL-3.0-or-later
"""Attacks every command with failing and fatal file operations: `python tests/faults/attack.py --faults 200 --kills
100`.

Each attempt runs a command with one fault, looks at what it left, and runs it again without a fault. What has to hold:
the command ends; it reports a failure in a sentence, or its result is that of an unbroken run; no file under a final
name is cut short; the second run succeeds, gives the unbroken result and leaves nothing hidden behind. Files that
differ between two unbroken runs (logs with times) are checked for being whole only. Prints a table by command; the exit
status is 1 where anything failed. With --folder an attack that was cut off goes on: attempts that passed are not
repeated.
"""
from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
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

from core.system.files import write_json  # noqa: E402
from tests.faults.cases import CASES, INPUTS, Case, Snapshot, fit_argv, leftovers, snapshot, why_not_whole  # noqa: E402

UNBROKEN = Fault("none", 0)
LIMIT_S = 300.0
"""Time after which a command counts as hanging."""
WARM = {"fit": "core.fit.run_loop", "bake": "core.bake.bake", "transfer": "core.transfer.transfer",
        "export": "core.transfer.export", "remove": "core.removal.jobs.batch",
        "remove --run": "core.removal.jobs.fitted", "remove a video": "core.removal.jobs.clean_video",
        "eval": "core.metrics.evaluation", "eval-removal": "core.removal.evaluation",
        "train-removal": "core.removal.training.run", "lights": "core.lights",
        "make-flare": "core.fit.traced_flare", "solve": "core.capture.solve"}
"""Modules of the commands that are loaded once, before the forks."""
STAYS_HIDDEN = (".solve", ".held")
"""Hidden files that are kept on purpose: the work of a solve; an empty lock file that could not be removed, which the
next process locks again."""


def make_inputs(folder: Path, injector: Injector, names: Iterable[str]) -> None:
    """Make the inputs of these names (keys of INPUTS), unless an earlier attack in the same folder has made them.

    A file NAME.whole marks an input as complete.
    """
    from core.images.write import write_png
    from tests.core.captures import orbit
    from tests.core.flared import flared_capture
    from tests.core.removal_cases import network_file, picture
    from tests.core.test_lights import lit_capture
    from tests.core.test_solve import SIZE, shoot
    from tests.core.videos import stripes, write_video

    inputs = {name: folder / file for name, file in INPUTS.items()}

    def run(argv: list[str]) -> None:
        done = injector.run(argv, folder, UNBROKEN, 600)
        if done.status:
            raise RuntimeError(done.text)

    def write_pictures(place: Path, gain: float) -> None:
        for name in ("a.png", "b.png"):
            write_png(place / name, picture(80, 120).astype("float32") * gain / 255)

    def make_pairs() -> None:
        write_pictures(inputs["pairs"] / "gt", 0.6)
        write_pictures(inputs["pairs"] / "input", 0.8)

    def make_lit() -> None:
        lit_capture(inputs["lit"], 6, [(0.4, -0.5, 0.3)])
        (inputs["lit"] / "lights.json").unlink(missing_ok=True)

    makers: dict[str, Callable[[], object]] = {
        "capture": lambda: flared_capture(inputs["capture"], count=7, dots=60),
        "run": lambda: run(fit_argv(inputs["capture"], inputs["run"])),
        "layers": lambda: run(["bake", str(inputs["run"]), "--out", str(inputs["layers"]), "--frames", "1-3"]),
        "lit": make_lit, "pairs": make_pairs, "backgrounds": lambda: write_pictures(inputs["backgrounds"], 0.6),
        "weights": lambda: network_file(inputs["weights"], bias=0.2),
        "shot": lambda: shoot(inputs["shot"], orbit(8, size=SIZE, arc=0.7)),
        "clip": lambda: write_video(inputs["clip"], "ffv1", "yuv444p", [stripes(64) * gain for gain in (1.0, 0.8)],
                                    tags=(1, 1, 1))}
    folder.mkdir(parents=True, exist_ok=True)
    for name in dict.fromkeys(names):
        whole = folder / f"{name}.whole"
        if not whole.exists():
            shutil.rmtree(inputs[name], ignore_errors=True)
            makers[name]()
            whole.touch()


class Journal:
    """Attempts of this attack and of earlier ones in the same folder: one line of JSON each."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.failures: dict[tuple[str, str], list[str]] = {}
        self.outcomes: dict[tuple[str, str], str] = {}
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                self._enter(**json.loads(line))

    def add(self, case: str, fault: Fault, outcome: str, failures: list[str]) -> None:
        """Note an attempt and what did not hold; it replaces an earlier one with the same fault."""
        entry = {"case": case, "fault": str(fault), "outcome": outcome, "failures": failures}
        self._enter(**entry)
        with open(self._path, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry) + "\n")

    def has_passed(self, case: str, fault: Fault) -> bool:
        """True if the attempt was made and everything held."""
        return self.failures.get((case, str(fault))) == []

    def _enter(self, case: str, fault: str, outcome: str, failures: list[str]) -> None:
        self.failures[case, fault], self.outcomes[case, fault] = failures, outcome


class Attack:
    """The attempts on one command, below `folder`."""

    def __init__(self, case: Case, inputs: Path, folder: Path, injector: Injector, journal: Journal) -> None:
        """Run the command twice without a fault, unless unbroken.json is there, to learn its files and how many calls
        it makes.

        Files that differ between the two runs count as varying: their content is not compared.
        """
        self.case, self._inputs, self._injector, self._journal = case, inputs, injector, journal
        self.out = folder / "out"
        self._failures: list[str] = []
        stored = folder / "unbroken.json"
        if not stored.exists():
            first, _ = self._unbroken()
            second, outcome = self._unbroken()
            if first.keys() != second.keys():
                raise RuntimeError(f"{case.name} writes other files each time")
            varying = [name for name in second if first[name] != second[name]]
            write_json(stored, {"files": second, "varying": varying, "calls": outcome.counts})
        read = json.loads(stored.read_text(encoding="utf-8"))
        self.reference: Snapshot = read["files"]
        self.varying = set(read["varying"])
        self._calls: dict[str, int] = read["calls"]

    def faults(self, number: int, kill: bool) -> list[Fault]:
        """Return `number` different faults, spread evenly over the kinds of calls and over the calls of each kind.

        The choice depends on the command's name alone. kill: the faults end the process in place of an error.
        """
        chance = random.Random(f"{self.case.name} {kill}")
        used = [call for call in CALLS if self._calls[call]]
        faults: dict[Fault, None] = {}
        for index in range(20 * number):
            call, turn = used[index % len(used)], index // len(used)
            turns = max(-(-number // len(used)), 1)
            at = 1 + int((turn % turns + chance.random()) / turns * self._calls[call])
            error = "kill" if kill else chance.choice(ERRORS)
            sticky = error == "ENOSPC" and call == "write" and chance.random() < 0.5
            faults.setdefault(Fault(call, at, error, sticky))
            if len(faults) == number:
                break
        return list(faults)

    def try_one(self, fault: Fault) -> None:
        """Run the command with the fault, then without; write into the journal what does not hold."""
        self._failures = []
        self._reset()
        outcome = "hangs"
        try:
            outcome = self._run_twice(fault)
        except TimeoutError as problem:
            self._fail(fault, str(problem))
        self._journal.add(self.case.name, fault, outcome, self._failures)

    def _run_twice(self, fault: Fault) -> str:
        """Run with the fault and again without, and check both; return how the run with the fault ended."""
        argv = self.case.argv(self._inputs, self.out)
        ending = self._check_broken(fault, self._injector.run(argv, self.out, fault, LIMIT_S))
        again = self._injector.run(argv, self.out, UNBROKEN, LIMIT_S)
        if again.status:
            self._fail(fault, f"the second run ends with {again.status}: {again.text[-600:]}")
            return ending
        self._compare(fault, "the second run")
        left = [name for name in leftovers(self.out) if not any(part in name for part in STAYS_HIDDEN)]
        if left:
            self._fail(fault, f"the second run leaves {left}")
        return ending

    def _check_broken(self, fault: Fault, outcome: Outcome) -> str:
        """Check a run with a fault: an honest ending, and only whole files. Return how it ended, in words."""
        killed = fault.error == "kill"
        ending = "other"
        if outcome.status == 0:
            ending = "harmless"
            self._compare(fault, "success reported")
        elif killed and outcome.status == -9:
            ending = "killed"
        elif outcome.status in (1, 2):
            ending = "refused in a sentence"
            if "Traceback" in outcome.text or "defect of Fit Flare" in outcome.text or "error:" not in outcome.text:
                self._fail(fault, f"no sentence: {outcome.text[-1200:]}")
        else:
            self._fail(fault, f"status {outcome.status}: {outcome.text[-600:]}")
        for name in snapshot(self.out):
            reason = why_not_whole(self.out / name)
            if reason:
                self._fail(fault, f"{name} is not whole: {reason}")
        return ending

    def _compare(self, fault: Fault, what: str) -> None:
        now, may_vary = snapshot(self.out), self.varying | self.case.varies
        other = [name for name in sorted({*now, *self.reference} - may_vary)
                 if now.get(name) != self.reference.get(name)]
        other += [name for name in sorted(may_vary & self.reference.keys()) if name not in now]
        if other:
            self._fail(fault, f"{what}, but other than unbroken: {other[:6]}")

    def _fail(self, fault: Fault, text: str) -> None:
        self._failures.append(text)
        print(f"FAILED {self.case.name}, {fault}: {text}", flush=True)

    def _reset(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir(parents=True)
        self.case.prepare(self._inputs, self.out)

    def _unbroken(self) -> tuple[Snapshot, Outcome]:
        self._reset()
        outcome = self._injector.run(self.case.argv(self._inputs, self.out), self.out, UNBROKEN, 600)
        if outcome.status:
            raise RuntimeError(f"{self.case.name}: {outcome.text[-2000:]}")
        return snapshot(self.out), outcome


def attack(folder: Path, faults: int, kills: int, only: list[str], limit_s: float) -> int:
    """Attack the commands from this process, which has the library preloaded, for at most `limit_s`; return the exit
    status.

    faults, kills: numbers over all commands. only: names of commands, all if empty. Attempts that passed before are not
    repeated.
    """
    import torch

    end = time.monotonic() + limit_s

    torch.set_num_threads(1)
    injector, journal = Injector(folder / "log"), Journal(folder / "attempts.jsonl")
    inputs = folder / "inputs"
    chosen = [case for case in CASES if not only or case.name in only]
    for name in ("fit", "bake", *(case.name for case in chosen)):
        if name in WARM:
            importlib.import_module(f"fit_flare.{WARM[name]}")
    make_inputs(inputs, injector, [name for case in chosen for name in case.reads])
    attacks: list[Attack] = []
    for case in chosen:
        try:
            attacks.append(Attack(case, inputs, folder / case.name.replace(" ", "_"), injector, journal))
            print(f"{case.name}: {len(attacks[-1].reference)} files", flush=True)
        except (RuntimeError, TimeoutError) as problem:
            print(f"FAILED {case.name} without a fault: {problem}", flush=True)
    planned = []
    plans: dict[str, list[Fault]] = {}
    for index, one in enumerate(attacks):
        plan = [*one.faults(_part(faults, index, len(attacks)), kill=False),
                *one.faults(_part(kills, index, len(attacks)), kill=True)]
        plans[one.case.name] = plan
        # In turn over all commands, so that an attack that is cut off has been on each.
        planned += [((place + 0.5) / len(plan), one, fault) for place, fault in enumerate(_shuffled(plan))
                    if not journal.has_passed(one.case.name, fault)]
    for _, one, fault in sorted(planned, key=lambda entry: entry[0]):
        if time.monotonic() > end:
            print("The time is over.")
            break
        one.try_one(fault)
    failed = _print_table(attacks, plans, journal)
    return int(len(attacks) < len(chosen) or failed)


def _part(total: int, index: int, parts: int) -> int:
    """Return the share of part `index` where `total` is divided evenly."""
    return total * (index + 1) // parts - total * index // parts


def _shuffled(plan: list[Fault]) -> list[Fault]:
    """Return the plan in an order that is the same each time."""
    return random.Random(0).sample(plan, len(plan))


def _print_table(attacks: list[Attack], plans: dict[str, list[Fault]], journal: Journal) -> bool:
    """Print the attempts by command as a Markdown table; return whether any failed."""
    columns = ("faults", "kills", "refused in a sentence", "harmless", "killed", "failed")
    print(f"| command | {' | '.join(columns)} | files that vary |\n|{' --- |' * (len(columns) + 2)}")
    total: Counter[str] = Counter()
    for one in attacks:
        name, counts = one.case.name, Counter[str]()
        for fault in plans[name]:
            if (name, str(fault)) in journal.outcomes:
                counts["kills" if fault.error == "kill" else "faults"] += 1
                counts[journal.outcomes[name, str(fault)]] += 1
                counts["failed"] += bool(journal.failures[name, str(fault)])
        total += counts
        print(f"| {name} | {' | '.join(str(counts[column]) for column in columns)} | "
              f"{', '.join(sorted(one.varying | one.case.varies))} |")
    print(f"| all | {' | '.join(str(total[column]) for column in columns)} | |", flush=True)
    return total["failed"] > 0


def main(argv: list[str]) -> int:
    """Start this script again with the library preloaded; there, carry out the attack. Return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--only", nargs="*", default=[], help="names of commands")
    parser.add_argument("--minutes", type=float, default=600.0, help="time after which it ends")
    parser.add_argument("--folder", type=Path, help="folder for the work, which is kept; an attack goes on there")
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
