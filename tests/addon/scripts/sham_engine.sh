#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Stands in for an engine's Python: does what the file `behaviour` beside it says.
here=$(dirname "$0")
out=
previous=
for word in "$@"; do
  [ "$previous" = --out ] && out=$word
  previous=$word
done
echo '{"type": "stage", "name": "fit", "total": 100, "done": 0}'
echo '{"type": "progress", "stage": "fit", "done": 40, "total": 100, "left_s": 6.0, "figures": {"loss": 0.1}}'
case $(cat "$here/behaviour") in
  dies) echo "out of memory, says the system" >&2; kill -9 $$ ;;
  vanishes) kill -9 $$ ;;
  refuses) echo '{"type": "error", "text": "The frames are not there; put them back."}'; exit 1 ;;
  chatters) echo 'no JSON'; echo '{"type": 7'; echo '[]'; echo '{"text": 1}'; exit 3 ;;
  ends) exit 0 ;;
  fills) mkdir -p "$out"; echo layer > "$out/layers.0001.exr"
         echo '{"type": "error", "text": "The disk is full (layers.0002.exr); make room and start it again, what is finished is kept."}'
         exit 1 ;;
  breaks) mkdir -p "$out"; echo layer > "$out/layers.0001.exr"; kill -9 $$ ;;
  bakes) [ -f "$out/layers.0001.exr" ] && echo layer > "$out/layers.0002.exr"
         echo '{"type": "result", "data": {"layers": "x", "frames": 2}}' ;;
  finishes) mkdir -p "$out"; cp "$here/lamp.flare" "$out/flare.flare"; echo '{"type": "result", "data": {"run": "x"}}' ;;
  makes) cp "$here/lamp.flare" "$out"; echo "$@" > "$here/arguments"; echo '{"type": "result", "data": {"flare": "x"}}' ;;
  answers) echo '{"type": "result", "data": {"version": "1", "torch": "2", "device": "a sham"}}' ;;
  sleeps) trap 'echo "{\"type\": \"error\", \"text\": \"Stopped during fit as asked; what is done is kept.\"}"; exit 130' INT
          n=0; while [ $n -lt 300 ]; do sleep 0.1; n=$((n + 1)); done ;;
esac
