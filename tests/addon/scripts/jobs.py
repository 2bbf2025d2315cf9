# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: jobs that other machines, files and scenes started. Arguments: the zip, a folder."""
from __future__ import annotations

import contextlib
import io
import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part

package, out = sys.argv[1], Path(sys.argv[2])
install(package)
sys.path.remove(str(Path(__file__).parent))
jobs = part("flare_addon.jobs")
facts: dict[str, object] = {}
signal.signal(signal.SIGINT, signal.SIG_DFL)  # a test run in the background has it ignored, and so would what it starts
sleeper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])
RESULT = '{"type": "result", "data": {}}\n'
GOES_ON = '{"type": "progress", "stage": "fit", "done": 4, "total": 8, "left_s": 1, "figures": {}}\n'


def begun(name: str, events: str, **record: object) -> Path:
    """A folder as an engine leaves it that was started elsewhere, or by an earlier Blender."""
    folder = out / name
    folder.mkdir(parents=True)
    (folder / jobs.EVENTS).write_text(events)
    (folder / jobs.RECORD).write_text(json.dumps(
        {"kind": "fit", "pid": sleeper.pid, "started": time.time(), "words": []} | record))
    return folder


# ---- another machine --------------------------------------------------------------------------------
ended = []
jobs.ON_FINISHED["fit"] = lambda job: ended.append(job.folder.name)
facts["ended elsewhere"] = jobs.find_job(begun("ended elsewhere", RESULT, host="another")).state
far = jobs.find_job(begun("goes on elsewhere", GOES_ON, host="another"))
facts["goes on elsewhere"] = [far.state, far.done]
far.stop()
facts["asked elsewhere"] = [(far.folder / jobs.STOP).exists(), far.stage]
with open(far.folder / jobs.EVENTS, "a") as stream:
    stream.write('{"type": "error", "text": "Stopped during fit as asked; what is done is kept."}\n')
far.poll()
facts["stopped elsewhere"] = [far.poll(), far.state, ended]
silent = begun("silent", GOES_ON, host="another")
os.utime(silent / jobs.EVENTS, (0, time.time() - 2 * jobs.SILENCE_LIMIT_S))
named = begun("named", GOES_ON, host="6f1c", host_name="studio-mac")
os.utime(named / jobs.EVENTS, (0, time.time() - 2 * jobs.SILENCE_LIMIT_S))
facts["silent on a Mac"] = jobs.find_job(named).error
facts["silent elsewhere"] = [jobs.find_job(silent).state, jobs.find_job(silent).error]

# ---- events that no engine writes -----------------------------------------------------------------
strange = ["[" * 5000, '"text"', "null", '{"type": []}', '{"type": "stage"}', '{"type": "result", "data": [1]}',
           '{"type": "progress", "done": 1e999, "total": 8, "figures": {}}',
           '{"type": "progress", "done": 5, "total": 8, "figures": {"loss": "x"}}', "x" * (5 << 20)]
odd = jobs.find_job(begun("odd", "\n".join([*strange, GOES_ON]), host="another"))
while odd.poll() and odd.done != 4:
    pass
facts["strange events"] = [odd.state, odd.done, odd.total]
jobs.stop_watching(odd.folder)
piped = begun("piped", "", host="another")
(piped / jobs.EVENTS).unlink()
os.mkfifo(piped / jobs.EVENTS)
facts["events from a pipe"] = jobs.find_job(piped).done
jobs.stop_watching(piped)

# ---- what is done in the scenes with one goes wrong ---------------------------------------------------
goes_on, ends = (jobs.find_job(begun(name, GOES_ON, host="another")) for name in ("goes on still", "ends badly"))
jobs.ON_FINISHED["fit"] = lambda _job: [].pop()
with open(ends.folder / jobs.EVENTS, "a") as stream:
    stream.write(RESULT)
with contextlib.redirect_stderr(io.StringIO()) as console:
    again = jobs._poll_jobs()
facts["ends badly"] = [again, ends.state, ends.error, "IndexError" in console.getvalue(), goes_on.state]
jobs.stop_watching(goes_on.folder)

# ---- this machine -----------------------------------------------------------------------------------
facts["written by the version before"] = [jobs.find_job(begun("old", GOES_ON)).state,
                                          jobs.find_job(begun("by name", GOES_ON,
                                                          host=platform.node())).origin.host == jobs.HOST]
# As when this machine was started anew since.
later = jobs.find_job(begun("later", GOES_ON, started=time.time() + 3600))
facts["its number is an older process's"] = later.state
found = jobs.find_job(begun("given out again", GOES_ON))
found.origin.started -= 3600  # as when its engine ended unseen, and the number went to another process
found.stop()
time.sleep(0.5)
facts["the stranger lives"] = sleeper.poll() is None
facts["asked by the file alone"] = (found.folder / jobs.STOP).exists()

# ---- of this scene, and of none ---------------------------------------------------------------------
sleepers = [subprocess.Popen([sys.executable, "-c", "import time; print(flush=True); time.sleep(100)"],
                             stdout=subprocess.PIPE) for _ in range(3)]
for process in sleepers:
    process.stdout.readline()  # a Python that still starts may ignore a signal
own, other, bake = (begun(name, GOES_ON, pid=process.pid, kind=kind) for name, process, kind in zip(
    ("own", "other", "layers"), sleepers, ("fit", "fit", "bake"), strict=True))
shots, scene = part("flare_addon.shots"), empty()
scene.fit_flare.run = str(own)
for folder in (own, other, bake):
    jobs.find_job(folder)
facts["of the scene"] = [job.folder.name for job in shots.running_jobs(scene)]
facts["of none"] = [job.folder.name for job in shots.orphaned_jobs()
                    if job.folder.name not in ("old", "by name", "given out again")]
cancel = part("flare_addon.operators.fit").FITFLARE_OT_cancel_by_key
over = SimpleNamespace(region=SimpleNamespace(type="UI", active_panel_category="Fit Flare"), scene=scene,
                       screen=SimpleNamespace(is_animation_playing=True))
facts["ESC while it plays"] = cancel.poll(over)
over.screen.is_animation_playing = False
facts["ESC"] = cancel.poll(over)
cancel.execute(SimpleNamespace(report=lambda *_words: None), over)
sleepers[0].wait(20)
facts["stopped by ESC"] = [process.poll() is not None for process in sleepers]
scene.fit_flare.run = ""
facts["ESC without work of its own"] = cancel.poll(over)
for process in sleepers:
    process.kill()
    process.wait()
sleeper.kill()
sleeper.wait()
leave(facts)
