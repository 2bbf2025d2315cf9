# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a function in a child process, for libraries that abort the process instead of raising an exception.

`run_in_child` returns what the function returns and raises what it raises; the death of the child becomes ChildDied.
Progress passes to the parent step by step, and a stop request back, as if the function ran here. `core/capture/solve`
runs pycolmap so. Arguments and results travel by pickle between a process and its own child.
"""
from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, BinaryIO

from ..errors import Cancelled
from .processes import child_environment, new_process_group
from .progress import Progress

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGE = __name__.removesuffix("core.system.child").rstrip(".")
"""Name of the package that this tree is imported as; "" where `core` is."""
_START = """import importlib, importlib.util, sys
sys.path[:], package, root, child = {path!r}, {package!r}, {root!r}, {module!r}
if package:
    spec = importlib.util.spec_from_file_location(package, root + "/__init__.py", submodule_search_locations=[root])
    sys.modules[package] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[package])
importlib.import_module(child).serve()"""


class ChildDied(Exception):
    """The child ended without a result; the text is its last stage and how it ended."""


def run_in_child(function: Callable[..., Any], *args: Any, progress: Progress) -> Any:
    """Return `function(*args, progress)`, called in a child process.

    function: defined at the top level of a module, so that the child can import it. Raises what the function and
    `progress` raise, and ChildDied where the child dies, for instance because a library aborts it.
    """
    search_path = [*([] if _PACKAGE else [str(_ROOT)]), *filter(None, sys.path)]  # "" is the working folder
    code = _START.format(path=search_path, package=_PACKAGE, root=str(_ROOT), module=__name__)
    with subprocess.Popen([sys.executable, "-I", "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          stderr=subprocess.DEVNULL, env=child_environment(), **new_process_group()) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            return _exchange_messages(process.stdin, process.stdout, (function, args), progress)
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as problem:
            process.kill()
            status = process.wait()
            ending = signal.Signals(-status).name if status < 0 else f"status {status}"
            raise ChildDied(f"{progress.stage_name or 'start-up'}, {ending}") from problem
        finally:
            process.kill()


def _exchange_messages(to_child: IO[bytes], from_child: IO[bytes], call: tuple[Callable[..., Any], tuple[Any, ...]],
                       progress: Progress) -> Any:
    """Send a call to the child, repeat its calls of `progress` here, and return or raise what the call does.

    Each message of the child gets a reply: True to continue, False to stop. An exception of `progress` makes the reply
    False, and is raised here when the child has ended its work."""
    _send(to_child, call)
    progress_error: BaseException | None = None
    while True:
        kind, *message = pickle.load(from_child)
        if kind == "returned":
            if progress_error is not None:
                raise progress_error
            return message[0]
        if kind == "raised":
            raise progress_error or message[0]
        try:
            if progress_error is None:
                name, args, figures = message
                getattr(progress, name)(*args, **figures)
        except BaseException as problem:  # raised when the child has ended its work
            progress_error = problem
        _send(to_child, progress_error is None)


def _send(stream: IO[bytes], message: Any) -> None:
    """Write one message at once."""
    pickle.dump(message, stream)
    stream.flush()


class _ChildProgress(Progress):
    """Progress in the child: sends each call to the parent, which answers whether to continue."""

    def __init__(self, to_parent: BinaryIO, replies: queue.Queue[Any]) -> None:
        super().__init__()
        self._to_parent, self._replies = to_parent, replies
        self._lock = threading.Lock()

    def stage(self, name: str, total: int, done: int = 0) -> None:
        self._stage = name
        self._pass_on("stage", name, total, done)

    def advance(self, steps: int = 1, **figures: float) -> None:
        self._pass_on("advance", steps, **figures)

    def say(self, text: str) -> None:
        self._pass_on("say", text)

    def check(self) -> None:
        self._pass_on("check")

    def _pass_on(self, name: str, *args: Any, **figures: float) -> None:
        """Have the parent call the method `name` of its progress. Raises Cancelled where the parent says to stop."""
        with self._lock:
            _send(self._to_parent, ("progress", name, args, figures))
            if not self._replies.get():
                raise Cancelled(f"Stopped during {self._stage or 'start-up'} as requested; what is done is kept.")


def serve() -> None:
    """Run the call that the parent sends; the child's main function."""
    for name in ("SIGINT", "SIGHUP", "SIGBREAK"):  # only the parent reacts to these signals
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    # Messages get descriptors of their own; 0 and 1, which libraries read and print to, become the null device.
    from_parent, to_parent = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1):
        os.dup2(null_device, descriptor)
    function, args = pickle.load(from_parent)
    replies: queue.Queue[Any] = queue.Queue()
    threading.Thread(target=_receive, args=(from_parent, replies), daemon=True).start()
    try:
        answer: tuple[str, Any] = ("returned", function(*args, _ChildProgress(to_parent, replies)))
    except BaseException as problem:
        answer = ("raised", problem)
    try:
        data = pickle.dumps(answer)
    except Exception:  # the exception cannot be pickled
        data = pickle.dumps(("raised", RuntimeError(f"{type(answer[1]).__name__}: {answer[1]}")))
    to_parent.write(data)
    to_parent.flush()
    os._exit(0)


def _receive(stream: BinaryIO, replies: queue.Queue[Any]) -> None:
    """Hand on the parent's replies; end the process where the parent has ended."""
    try:
        while True:
            replies.put(pickle.load(stream))
    except (EOFError, OSError, pickle.UnpicklingError):
        os._exit(1)
