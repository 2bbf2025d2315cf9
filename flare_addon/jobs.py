# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: commands of the engine in processes of their own, which Blender follows by a file of events.

    FOLDER/job.json       kind, arguments, machine and process number of the job
    FOLDER/events.jsonl   its events, one JSON object per line (core/system/progress.py)
    FOLDER/engine.log     its other output
    FOLDER/stop           exists once the job was asked to stop

`engine.run` starts a job; `fits` and `shots` register in `ON_FINISHED` what happens in the scenes at its end. The
events go to a file, not a pipe, so that Blender can be closed and opened again during a job, and finds it by its
folder. A timer reads new events in small pieces, so the window never waits. Without a window the same calls wait for
the end. Whether a job on another machine is running, in a folder that both can access, is known from its events alone.
"""
from __future__ import annotations

import contextlib
import os
import platform
import shutil
import signal
import subprocess
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import bpy

from ..core.errors import DISK_FULL, EngineError, FitFlareError, RunError, os_error_message
from ..core.system import processes
from ..core.system.files import remove_file, write_json
from ..core.system.processes import STOPPED, WINDOWS, new_process_group
from ..core.system.progress import STOP_FILE
from ..core.system.reading import open_regular, parse_json, read_bytes, read_text
from .paths import is_file, is_folder

State = Literal["running", "done", "failed", "stopped"]

RECORD, EVENTS, LOG, STOP = "job.json", "events.jsonl", "engine.log", "stop"
HOST = processes.machine_id()
POLL_INTERVAL_S = 0.2
NICENESS = 5
SIDEBAR_TAB = "Fit Flare"
READ_CHUNK = 1 << 16  # bytes of events
MAX_EVENT_BYTES = 1 << 22  # of one event; results name many files
SILENCE_LIMIT_S = 3600.0  # a job on another machine without events for so long counts as failed
MIN_FREE_BYTES = 1 << 16  # a disk with less free space counts as full

ON_FINISHED: dict[str, Callable[[Job], None]] = {}
"""The function to call when a job has ended, by kind of job."""

_jobs: dict[str, Job] = {}


@dataclass
class Origin:
    """The process that a job runs in.

    pid: its number, 0 where it has ended. host: id of its machine, `host_name` its name for people. started: seconds
    since the epoch, which tells the process from a later one of the same number. log_offset: bytes that the log had
    before.
    """

    pid: int
    host: str = HOST
    host_name: str = ""
    started: float = 0.0
    log_offset: int = 0


class Job:
    """One command of the engine.

    done, total: steps of `stage`. eta_s: remaining seconds, None where unknown. figures: numbers of its last progress
    by name, such as losses. messages: sentences for the user. result: data of its result events. warnings: sentences on
    what Blender did with the result. args: those that identify the job, without --overwrite, which changes no result.
    """

    def __init__(self, kind: str, folder: Path, origin: Origin, args: Sequence[str] = (),
                 process: subprocess.Popen[bytes] | None = None) -> None:
        """Represent a job in its folder; `poll` reads its events.

        process: the running process, if this Blender started it.
        """
        self.kind, self.folder, self.origin = kind, folder, origin
        self.args = [arg for arg in args if arg != "--overwrite"]
        self.state: State = "running"
        self.stage, self.done, self.total = "starting", 0, 0
        self.eta_s: float | None = None
        self.figures: dict[str, float] = {}
        self.messages: list[str] = []
        self.warnings: list[str] = []
        self.result: dict[str, Any] = {}
        self.error = ""
        self._process, self._was_seen_running, self._has_result = process, process is not None, False
        self._offset, self._partial_line = 0, b""

    @property
    def running(self) -> bool:
        return self.state == "running"

    @property
    def fraction_done(self) -> float:
        """The part of the stage that is done, 0..1."""
        return min(self.done / self.total, 1.0) if self.total else 0.0

    @property
    def log(self) -> Path:
        return self.folder / LOG

    def poll(self) -> bool:
        """Read new events, and at the end of the job call its function in ON_FINISHED; return whether anything
        changed."""
        if not self.running:
            return False
        previous_offset = self._offset
        alive = self._is_alive()  # asked before reading, so that the last events of a process that ends are read
        self._read()
        if alive:
            self._was_seen_running = True
            return self._offset > previous_offset
        while self._read():
            pass
        self._finish()
        if self._was_seen_running and self.kind in ON_FINISHED:  # else an earlier session handled the end
            ON_FINISHED[self.kind](self)
        return True

    def stop(self) -> None:
        """Ask the process to stop; it saves its state and ends by itself.

        This is done by a file, since on Windows a signal reaches processes of the same console only. On other systems
        a signal is sent too: it also works during start-up, and a second one ends a process that does not react. On
        another machine, or where the process number was reused, there is no signal.
        """
        if not self.running or not self._is_alive():
            return
        self.stage = "stopping"
        with contextlib.suppress(OSError):
            (self.folder / STOP).touch()
        origin = self.origin
        if not WINDOWS and origin.host == HOST and (
                self._process or processes.is_same_process(origin.pid, origin.started)):
            with contextlib.suppress(OSError):
                os.kill(origin.pid, signal.SIGINT)

    def _read(self) -> bool:
        """Read and handle one piece of new events; return whether there was any."""
        try:
            with open_regular(self.folder / EVENTS) as stream:
                stream.seek(self._offset)
                data = stream.read(READ_CHUNK)
        except OSError:  # the folder was removed, or does not exist yet
            return False
        self._offset += len(data)
        *lines, self._partial_line = (self._partial_line + data).split(b"\n")
        if len(self._partial_line) > MAX_EVENT_BYTES:  # no engine writes such a line
            self._partial_line = b""
        for line in lines:
            self._handle_event(line)
        return bool(data)

    def _handle_event(self, line: bytes) -> None:
        """Update the state from one line of events; other lines are ignored, and events with other values."""
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, OverflowError):
            event = parse_json(line)
            self._apply_event(event["type"], event)

    def _apply_event(self, kind: str, event: Mapping[str, Any]) -> None:
        """Update the state from an event. Raises KeyError, TypeError or ValueError where its values are invalid."""
        if kind == "stage":
            name, done, total = str(event["name"]), int(event["done"]), int(event["total"])
            self.stage, self.done, self.total, self.eta_s = name, done, total, None
        elif kind == "progress":
            # left_s: the name of eta_s in an earlier version
            done, total, eta_s = int(event["done"]), int(event["total"]), event.get("eta_s", event.get("left_s"))
            figures = {str(name): float(value) for name, value in event["figures"].items()}
            self.done, self.total, self.eta_s = done, total, None if eta_s is None else float(eta_s)
            self.figures = figures
        elif kind == "say":
            self.messages.append(str(event["text"]))
        elif kind == "result":
            self.result.update({str(name): value for name, value in event["data"].items()})
            self._has_result = True
        elif kind == "error":
            self.error = str(event["text"])

    def _is_alive(self) -> bool:
        """Return whether the process of the job is running; on another machine this is judged by its events."""
        if self._process is not None:
            return self._process.poll() is None
        if self.origin.host != HOST:
            while self._read():
                pass
            return not (self._has_result or self.error or self._is_silent())
        return self.origin.pid > 0 and processes.is_running(self.origin.pid)

    def _is_silent(self) -> bool:
        """Return whether a job on another machine has written no event for SILENCE_LIMIT_S."""
        try:
            return time.time() - (self.folder / EVENTS).stat().st_mtime > SILENCE_LIMIT_S
        except OSError:
            return True

    def _finish(self) -> None:
        """Set the final state after the process has ended, from its events, its exit status and its folder."""
        status = self._process.returncode if self._process is not None else None
        if self._has_result:
            self.state = "done"
        elif self.error and (status == STOPPED or self.error.startswith("Stopped")):
            self.state = "stopped"
        elif self.error:
            self.state = "failed"
        elif self.origin.host != HOST and is_folder(self.folder):
            self.state = "failed"
            self.error = (f"The engine on {self.origin.host_name or self.origin.host} has reported nothing for an "
                          f"hour; check there whether it still runs in {self.folder}.")
        elif not is_folder(self.folder):
            self.state, self.error = "failed", f"The folder {self.folder} was removed while the engine used it."
        elif _is_full(self.folder):  # the error event could not be written either
            self.state = "failed"
            self.error = f"The disk of {self.folder} is full; make room and start it again, what is finished is kept."
        elif is_file(self.folder / STOP):  # it stopped before it wrote any event
            self.state, self.error = "stopped", "Stopped before it began."
        else:
            self.state = "failed"
            self.error = f"The engine ended without a result{self._last_log_line()}; see {LOG} in {self.folder}."

    def _last_log_line(self) -> str:
        """Return the last line of the job's log in brackets and quotes; "" without one."""
        try:
            text = read_bytes(self.log)[self.origin.log_offset:].decode("utf-8", errors="replace")
        except OSError:
            return ""
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return f' ("{lines[-1][:160]}")' if lines else ""


def _is_full(folder: Path) -> bool:
    """Return whether the disk of a folder is full."""
    try:
        return shutil.disk_usage(folder).free < MIN_FREE_BYTES
    except OSError:
        return False


# ---- starting and finding jobs ------------------------------------------------------------------------


def start_job(kind: str, folder: Path, command: Sequence[str], environment: Mapping[str, str] | None = None, *,
              args: Sequence[object] = ()) -> Job:
    """Start a command whose events go to `folder`, and follow it.

    args: the arguments that identify the job. environment: variables of the process; None for Blender's. Without a
    window this waits for the end of the job. Raises EngineError where the command cannot be started, RunError where the
    folder cannot be written or a job runs in it.
    """
    earlier_job = find_job(folder)
    if earlier_job is not None and earlier_job.running:
        raise RunError(f"The engine already works in {folder}; wait for it, or cancel it first.")
    process_options = new_process_group()
    if WINDOWS:
        process_options["creationflags"] |= getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_file(folder / STOP)
        with open(folder / EVENTS, "wb") as events, open(folder / LOG, "ab") as log:
            log_offset = log.tell()
            process = _launch(command, stdin=subprocess.DEVNULL, stdout=events, stderr=log,
                              env={**(os.environ if environment is None else environment),
                                   STOP_FILE: str((folder / STOP).absolute())}, **process_options)
        _lower_priority(process.pid)
        try:
            write_json(folder / RECORD, {"kind": kind, "host": HOST, "host_name": platform.node(), "pid": process.pid,
                                         "started": time.time(), "args": [str(arg) for arg in args],
                                         "log_from": log_offset})
        except OSError:
            process.kill()  # it could not be found again
            raise
    except OSError as problem:
        if problem.errno in DISK_FULL:
            raise RunError(os_error_message(problem)) from problem
        raise RunError(f"{folder} cannot be used ({problem.strerror or problem}); choose another folder.") from problem
    job = Job(kind, folder, Origin(process.pid, log_offset=log_offset), [str(arg) for arg in args], process)
    _jobs[_key(folder)] = job
    if bpy.app.background:
        _wait(job)
    else:
        _watch()
    return job


def _launch(command: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a process. Raises EngineError where the system cannot start it."""
    try:
        return subprocess.Popen(list(command), **options)
    except OSError as problem:
        raise EngineError(f"{command[0]} cannot be started ({problem.strerror or problem}); set up the engine in the "
                          "preferences.") from problem


def _lower_priority(pid: int) -> None:
    """Lower the priority of the engine, which uses every core, so that Blender's window stays responsive."""
    if not WINDOWS:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, pid, NICENESS)


def find_job(folder: Path | str | None) -> Job | None:
    """Return the job in a folder, also one that an earlier Blender started; None where there is none."""
    if not folder:
        return None
    folder = Path(folder)
    job_in_memory = _jobs.get(_key(folder))
    if job_in_memory is not None:
        return job_in_memory
    try:
        record = parse_json(read_text(folder / RECORD))
        # The first version stored no host, and a later one the host name, which on a Mac is not the machine's id.
        pid, host = int(record["pid"]), str(record.get("host", HOST))
        host = HOST if host == platform.node() else host
        started = float(record["started"])
        is_running = host == HOST and processes.is_same_process(pid, started)
        origin = Origin(pid if is_running else 0, host, str(record.get("host_name", "")), started,
                        int(record.get("log_from", 0)))
        # words: the name of args in an earlier version
        job = Job(str(record["kind"]), folder, origin, list(map(str, record.get("args", record.get("words", ())))))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None
    _jobs[_key(folder)] = job
    job.poll()
    if job.running:
        _watch()
    return job


def stop_watching(folder: Path | str) -> None:
    """Forget the job in a folder; its process continues."""
    _jobs.pop(_key(Path(folder)), None)


def running() -> list[Job]:
    """Return all running jobs."""
    return [job for job in _jobs.values() if job.running]


def _key(folder: Path) -> str:
    """Return the key of a folder in `_jobs`."""
    return os.path.normcase(folder.absolute())


def _wait(job: Job) -> None:
    """Wait for the end of a job. Raises FitFlareError where it failed."""
    while job.running:
        job.poll()
        time.sleep(0.05)
    if job.state == "failed":
        raise FitFlareError(job.error)


def _watch() -> None:
    """Start the timer that polls the jobs."""
    if not bpy.app.background and not bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.register(_poll_jobs, first_interval=POLL_INTERVAL_S, persistent=True)


def _poll_jobs() -> float | None:
    """Poll the running jobs; return the seconds to the next call, None to stop the timer."""
    changes = [_poll_safely(job) for job in running()]
    if any(changes):
        redraw_bars()
    return POLL_INTERVAL_S if running() else None


def _poll_safely(job: Job) -> bool:
    """Poll a job; return whether there is anything new. An unexpected exception is shown in the panel and the console.

    It does not stop the polling of other jobs.
    """
    try:
        return job.poll()
    except Exception as problem:
        report_exception(job, problem)
        return True


def report_exception(job: Job, problem: Exception) -> None:
    """Show an unexpected exception, which is being handled, in the panel of a job and in the console."""
    traceback.print_exc()
    job.error = (f"An error occurred while Fit Flare showed or composited the result in {job.folder} "
                 f"({' '.join(str(problem).split())}); report it with the text in the console.")
    job.state = "failed" if job.running else job.state


def redraw_bars() -> None:
    """Redraw what shows progress: the sidebars with our tab, and the preferences.

    The 3D views are left out, since they are expensive to draw: the update callbacks of the properties redraw them.
    """
    for area in (area for window in bpy.context.window_manager.windows for area in window.screen.areas):
        if area.type == "PREFERENCES":
            area.tag_redraw()
        elif area.type in ("VIEW_3D", "NODE_EDITOR", "IMAGE_EDITOR"):
            for region in area.regions:
                if region.type == "UI" and region.active_panel_category == SIDEBAR_TAB:
                    region.tag_redraw()


def unregister() -> None:
    if bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.unregister(_poll_jobs)
    _jobs.clear()
