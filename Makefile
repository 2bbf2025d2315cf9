# make demo   sets everything up and runs the whole chain on the sample scene
# make test   sets everything up and runs the checks and tests
PYTHON ?= python3.11
PIP = -m pip --disable-pip-version-check --quiet
# Blender's modules are hundreds of megabytes: an installation whose download broke off is begun again after a pause.
AGAIN = sh -c 'for pause in 10 30 60 120; do "$$@" && exit; sleep $$pause; done; "$$@"' --

.PHONY: demo pictures test check setup package clean

demo: .venv/.ready
	.venv/bin/python headless/run.py demo

# The pictures of the README, from the demo.
pictures: demo
	.venv/bin/python -c "import cv2; cv2.imwrite('docs/contact_sheet.jpg', cv2.imread('build/demo/contact_sheet.png'), [cv2.IMWRITE_JPEG_QUALITY, 88])"
	.venv/bin/python -c "import cv2; cv2.imwrite('docs/lights.jpg', cv2.imread('build/demo/capture/lights/sheet1.png')[:606], [cv2.IMWRITE_JPEG_QUALITY, 88])"
	.venv/bin/python sample_scenes/make_library.py --sheet docs/library.jpg

test: setup check
	.venv/bin/python -m pytest -n logical --maxprocesses 4 --dist loadfile

check: .venv/.ready
	.venv/bin/ruff check .
	.venv/bin/mypy

setup: .venv/.ready .venv-bpy45/.ready

# The engine, with Blender as a module beside it.
.venv/.ready: constraints.txt pyproject.toml
	$(PYTHON) -m venv .venv
	$(AGAIN) .venv/bin/python $(PIP) install --upgrade pip
	$(AGAIN) .venv/bin/python $(PIP) install --group engine --group blender --group colour --group test -c constraints.txt
	touch $@

# An older Blender without an engine, for the tests of Blender's side.
.venv-bpy45/.ready: constraints.txt pyproject.toml
	$(PYTHON) -m venv .venv-bpy45
	$(AGAIN) .venv-bpy45/bin/python $(PIP) install bpy==4.5.15 numpy==1.26.4 OpenEXR==3.5.3
	touch $@

# The extension as Blender installs it.
package: .venv/.ready
	.venv/bin/python headless/package.py

clean:
	rm -rf build .venv .venv-bpy45
