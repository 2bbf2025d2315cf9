# SPDX-License-Identifier: GPL-3.0-or-later
"""Work of the engine, watched from Blender: a process of its own whose events land in a file.

    FOLDER/job.json       what was started, in which words, on which machine, and the process's number
    FOLDER/events.jsonl   its events, one JSON object a line (core/system/progress.py)
    FOLDER/engine.log     what else it said
    FOLDER/stop           there when it has been asked to stop

A file, not a pipe: the process needs nobody to read it, so Blender can be saved, closed and opened again
meanwhile, and finds the work by its folder. A timer looks at what is new in the file, a few kilobytes at a
time, so the window never waits. Without a window the same calls wait for the end. Of work on another machine, in a
folder that both see, the events alone tell whether it goes on.
"""
from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import signal
import subprocess
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import bpy

from ..core.errors import DISK_FULL, EngineError, FitFlareError, RunError, refusal
from ..core.system import processes
from ..core.system.files import remove_file, write_json
from ..core.system.processes import STOPPED, WINDOWS, own_group
from ..core.system.progress import STOP_FILE
from .paths import is_file, is_folder

State = Literal["running", "done", "failed", "stopped"]

RECORD, EVENTS, LOG, STOP = "job.json", "events.jsonl", "engine.log", "stop"
HOST = processes.machine()
EVERY_S = 0.2
NICENESS = 5
TAB = "Fit Flare"  # of the sidebar
AT_ONCE = 1 << 16  # bytes of events read at a time
SILENT_S = 3600.0  # another machine's engine that has told nothing for so long has died
FULL = 1 << 16  # a disk with fewer bytes free is full

FINISHERS: dict[str, Callable[[Job], None]] = {}
"""By kind of work: what is to be done in the scenes when it has ended."""

_jobs: dict[str, Job] = {}


class Job:
    """One command of the engine. done, total: steps of `stage`; left_s: seconds left, None where unknown. log_from:
    bytes of the log that commands before it have written. host: its machine, which people call `host_name`.
    started: when, in seconds since the epoch, by which one of an earlier Blender is known."""

    def __init__(self, kind: str, folder: Path, pid: int, process: subprocess.Popen[bytes] | None,
                 words: Sequence[str] = (), host: str = HOST, log_from: int = 0, host_name: str = "",
                 started: float = 0.0) -> None:
        self.kind, self.folder, self.pid, self.host, self.log_from = kind, folder, pid, host, log_from
        self.started = started
        self.host_name = host_name or host
        self.words = [word for word in words if word != "--overwrite"]
        self.state: State = "running"
        self.stage, self.done, self.total, self.left_s = "starting", 0, 0, None
        self.figures: dict[str, float] = {}
        self.said: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""
        self._process, self._watched, self._has_result = process, process is not None, False
        self._at, self._rest = 0, b""

    @property
    def running(self) -> bool:
        return self.state == "running"

    @property
    def share(self) -> float:
        """How much of the stage is done, 0..1."""
        return min(self.done / self.total, 1.0) if self.total else 0.0

    @property
    def log(self) -> Path:
        return self.folder / LOG

    def poll(self) -> bool:
        """Take in what is new; whether anything was."""
        if not self.running:
            return False
        before = self._at
        alive = self._alive()  # asked first: what was written before the end is then read below
        self._read()
        if alive:
            self._watched = True
            return self._at > before
        while self._read():
            pass
        self._end()
        if self._watched and self.kind in FINISHERS:  # what ended before this session was taken in then
            FINISHERS[self.kind](self)
        return True

    def stop(self) -> None:
        """Ask it to stop; it keeps what it has, and ends by itself.

        By a file, since on Windows a signal reaches only who shares a console; elsewhere by a signal too, which is
        heard in start-up, and of which a second one ends what does not answer. The number may be another process's, as
        it is on another machine, and then the file is all.
        """
        if not self.running or not self._alive():
            return
        self.stage = "stopping"
        with contextlib.suppress(OSError):
            (self.folder / STOP).touch()
        if not WINDOWS and self.host == HOST and (self._process or processes.is_same(self.pid, self.started)):
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGINT)

    def _read(self) -> bool:
        try:
            with open(self.folder / EVENTS, "rb") as stream:
                stream.seek(self._at)
                data = stream.read(AT_ONCE)
        except OSError:  # the folder was removed, or is not there yet
            return False
        self._at += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._take(line)
        return bool(data)

    def _take(self, line: bytes) -> None:
        try:
            event = json.loads(line)
            kind = event["type"]
        except (ValueError, KeyError, TypeError):
            return
        if kind == "stage":
            self.stage, self.done, self.total, self.left_s = event["name"], event["done"], event["total"], None
        elif kind == "progress":
            self.done, self.total, self.left_s = event["done"], event["total"], event["left_s"]
            self.figures = event["figures"]
        elif kind == "say":
            self.said.append(str(event["text"]))
        elif kind == "result":
            self.result.update(event["data"])
            self._has_result = True
        elif kind == "error":
            self.error = str(event["text"])

    def _alive(self) -> bool:
        if self._process is not None:
            return self._process.poll() is None
        if self.host != HOST:
            while self._read():
                pass
            return not (self._has_result or self.error or self._silent())
        return self.pid > 0 and processes.runs(self.pid)

    def _silent(self) -> bool:
        try:
            return time.time() - (self.folder / EVENTS).stat().st_mtime > SILENT_S
        except OSError:
            return True

    def _end(self) -> None:
        """The process is gone."""
        status = self._process.returncode if self._process is not None else None
        if self._has_result:
            self.state = "done"
        elif self.error and (status == STOPPED or self.error.startswith("Stopped")):
            self.state = "stopped"
        elif self.error:
            self.state = "failed"
        elif self.host != HOST and is_folder(self.folder):
            self.state = "failed"
            self.error = (f"The engine on {self.host_name} has told nothing for an hour; see there whether it works in "
                          f"{self.folder}.")
        elif not is_folder(self.folder):
            self.state, self.error = "failed", f"The folder {self.folder} was removed while the engine worked in it."
        elif _is_full(self.folder):  # then its last words found no room either
            self.state = "failed"
            self.error = f"The disk of {self.folder} is full; make room and start it again, what is finished is kept."
        elif is_file(self.folder / STOP):  # before it listened
            self.state, self.error = "stopped", "Stopped as asked before it began."
        else:
            self.state = "failed"
            self.error = f"The engine ended without a result{self._last_words()}; {LOG} in {self.folder} has it all."

    def _last_words(self) -> str:
        try:
            text = self.log.read_bytes()[self.log_from:].decode("utf-8", errors="replace")
        except OSError:
            return ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return f' ("{lines[-1][:160]}")' if lines else ""


def _is_full(folder: Path) -> bool:
    try:
        return shutil.disk_usage(folder).free < FULL
    except OSError:
        return False


# ---- starting and finding -------------------------------------------------------------------------


def start(kind: str, folder: Path, command: Sequence[str], environment: Mapping[str, str] | None = None, *,
          words: Sequence[object] = ()) -> Job:
    """Start a command whose events go to `folder`, and watch it. words: those of it that say what is made.

    Without a window this returns when it has ended. Raises EngineError where it cannot be started, RunError
    where the folder cannot be written or has work running in it.
    """
    before = find(folder)
    if before is not None and before.running:
        raise RunError(f"The engine works in {folder} already; wait for it or cancel it first.")
    apart = own_group()
    if WINDOWS:
        apart["creationflags"] |= getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_file(folder / STOP)
        with open(folder / EVENTS, "wb") as events, open(folder / LOG, "ab") as log:
            log_from = log.tell()
            process = _launched(command, stdin=subprocess.DEVNULL, stdout=events, stderr=log,
                                env={**(os.environ if environment is None else environment),
                                     STOP_FILE: str((folder / STOP).absolute())}, **apart)
        _yield_to_the_window(process.pid)
        try:
            write_json(folder / RECORD, {"kind": kind, "host": HOST, "host_name": platform.node(), "pid": process.pid,
                                          "started": time.time(), "words": [str(word) for word in words],
                                          "log_from": log_from})
        except OSError:
            process.kill()  # nobody would find it again
            raise
    except OSError as problem:
        if problem.errno in DISK_FULL:
            raise RunError(refusal(problem)) from problem
        raise RunError(f"{folder} cannot be used ({problem.strerror or problem}); choose another folder.") from problem
    job = Job(kind, folder, process.pid, process, [str(word) for word in words], log_from=log_from)
    _jobs[_key(folder)] = job
    if bpy.app.background:
        _wait(job)
    else:
        _watch()
    return job


def _launched(command: Sequence[str], **how: Any) -> subprocess.Popen[bytes]:
    """Raises EngineError where the system does not start it."""
    try:
        return subprocess.Popen(list(command), **how)
    except OSError as problem:
        raise EngineError(f"{command[0]} cannot be started ({problem.strerror or problem}); set up the engine in the "
                          "preferences.") from problem


def _yield_to_the_window(pid: int) -> None:
    """The engine takes every core, and Blender's window comes first where they are wanted."""
    if not WINDOWS:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, pid, NICENESS)


def find(folder: Path | str | None) -> Job | None:
    """The work in a folder: watched already, or left running by an earlier Blender; None where there is none."""
    if not folder:
        return None
    folder = Path(folder)
    known = _jobs.get(_key(folder))
    if known is not None:
        return known
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        pid, host = int(record["pid"]), str(record.get("host", HOST))  # an early version wrote none,
        host = HOST if host == platform.node() else host  # and the next a Mac's name
        started = float(record["started"])
        here = host == HOST and processes.is_same(pid, started)
        job = Job(str(record["kind"]), folder, pid if here else 0, None, list(map(str, record.get("words", ()))), host,
                  int(record.get("log_from", 0)), str(record.get("host_name", "")), started)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    _jobs[_key(folder)] = job
    job.poll()
    if job.running:
        _watch()
    return job


def forget(folder: Path | str) -> None:
    """Stop watching a folder; what runs there goes on."""
    _jobs.pop(_key(Path(folder)), None)


def running() -> list[Job]:
    """All work that goes on now."""
    return [job for job in _jobs.values() if job.running]


def _key(folder: Path) -> str:
    return os.path.normcase(folder.absolute())


def _wait(job: Job) -> None:
    while job.running:
        job.poll()
        time.sleep(0.05)
    if job.state == "failed":
        raise FitFlareError(job.error)


def _watch() -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=EVERY_S, persistent=True)


def _tick() -> float | None:
    news = [_polled(job) for job in running()]
    if any(news):
        _redraw_bars()
    return EVERY_S if running() else None


def _polled(job: Job) -> bool:
    """Whether anything is new of it. What nobody foresaw ends the watching of no other work: the panel tells that it
    was, and the console what."""
    try:
        return job.poll()
    except Exception as problem:
        traceback.print_exc()
        job.error = (f"What the engine left in {job.folder} cannot be shown ({' '.join(str(problem).split())}); report "
                     "it with what the console says.")
        job.state = "failed" if job.running else job.state
        return True


def _redraw_bars() -> None:
    """Have what shows progress drawn again: the sidebars with our tab and the preferences. Not the 3D views, which are
    dear to draw; where the work changes what they show, its properties say so."""
    for area in (area for window in bpy.context.window_manager.windows for area in window.screen.areas):
        if area.type == "PREFERENCES":
            area.tag_redraw()
        elif area.type == "VIEW_3D":
            for region in area.regions:
                if region.type == "UI" and region.active_panel_category == TAB:
                    region.tag_redraw()


def unregister() -> None:
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    _jobs.clear()
