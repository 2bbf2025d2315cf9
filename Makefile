# make demo   sets everything up and runs the whole chain on the sample scene
# make test   sets everything up and runs the checks and tests
PYTHON ?= python3.11
PIP = -m pip --disable-pip-version-check --quiet
# Blender's modules are hundreds of megabytes: an installation whose download broke off is begun again after a pause.
PAUSES = 10 30 60 120
AGAIN = sh -c 'for pause in $(PAUSES); do "$$@" && exit; sleep $$pause; done; "$$@"' --
# The first Python 3.13 that starts: the one on the PATH may be pyenv's stand-in for a version that is not selected.
PYTHON313 ?= $(shell for python in python3.13 "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/3.13.*/bin/python3.13; do \
	"$$python" -c "import ensurepip, venv" 2> /dev/null && echo "$$python" && break; done)

.PHONY: demo pictures test check kernels setup package clean

demo: .venv/.ready
	.venv/bin/python headless/run.py demo

# The pictures of the README, from the demo.
pictures: demo
	.venv/bin/python -c "import cv2; cv2.imwrite('docs/contact_sheet.jpg', cv2.imread('build/demo/contact_sheet.png'), [cv2.IMWRITE_JPEG_QUALITY, 88])"
	.venv/bin/python -c "import cv2; cv2.imwrite('docs/lights.jpg', cv2.imread('build/demo/capture/lights/sheet1.png')[:606], [cv2.IMWRITE_JPEG_QUALITY, 88])"
	.venv/bin/python sample_scenes/make_library.py --sheet docs/library.jpg

test: setup
	$(MAKE) --jobs 2 check kernels
	.venv/bin/python -m pytest -n logical --maxprocesses 4 --dist loadfile

# Machine code of the kernels, so that the tests' processes do not each compile it.
kernels: .venv/.ready
	.venv/bin/python -m tests.compile_kernels

check: .venv/.ready
	.venv/bin/ruff check .
	.venv/bin/mypy

setup: .venv/.ready .venv-bpy45/.ready .venv-bpy53/.ready

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

# The newest Blender, whose module needs Python 3.13. Without it, or where the installation fails, the other environments
# are complete, and the tests skip this Blender with the reason in .venv-bpy53.missing.
.venv-bpy53/.ready: PAUSES = 10 30
.venv-bpy53/.ready: constraints.txt pyproject.toml
	@rm -f $@
	@if [ -z "$(PYTHON313)" ]; then echo "no Python 3.13 was found" > .venv-bpy53.missing; \
	elif $(PYTHON313) -m venv .venv-bpy53 \
		&& $(AGAIN) .venv-bpy53/bin/python $(PIP) install bpy==5.3.0 numpy==2.5.5 OpenEXR==3.5.3; \
	then rm -f .venv-bpy53.missing && touch $@; \
	else echo "its installation failed (see the output of make setup)" > .venv-bpy53.missing; fi
	@[ ! -e .venv-bpy53.missing ] || echo "make setup: the tests leave out Blender 5.3: $$(cat .venv-bpy53.missing)"

# The extension as Blender installs it.
package: .venv/.ready
	.venv/bin/python headless/package.py

clean:
	rm -rf build .venv .venv-bpy45 .venv-bpy53 .venv-bpy53.missing
