# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample shots: what moves in them, by frame. `render_shot.py` renders them.

    torch    a locked-off camera; a torch is carried about, out of the frame and behind a screen at times; a walker
    drive    a moving camera; the two headlights of a car that approaches, of which the right one flickers and goes out
    pan      a camera that turns about its nodal point; a lamp that does not move; a walker and a cart cross

Each also has bright things that are no lamps: a window, lit windows, a white shirt. A seed changes textures, paths, the
lens and the colours of the lamps. Lengths are metres; axes are those of `raycast`.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from core.colour.srgb import linear_from_srgb

from . import patterns
from .description import Array, Pinhole
from .raycast import Lamp, Pixels, Quad, box_sides, quad

FRAMES = 40
WIDTH, HEIGHT = 480, 270
OUT_FRAMES = 8
"""Number of frames in which the right headlight of the drive is out."""


@dataclass(frozen=True, eq=False)
class FrameState:
    """One frame of a shot: eye (3,), rotation (3, 3) world to camera, moving rectangles, lamps and their strengths.

    strengths: of the lamps' flares, by lamp name: with nothing before the lamp, at the shot's `reference_distance`.
    """

    eye: Array
    rotation: Array
    moving: list[Quad]
    lamps: dict[str, Lamp]
    strengths: dict[str, float]


@dataclass(frozen=True, eq=False)
class ShotScene:
    """A shot: camera, lens setup, rectangles that do not move, ambient light (3,), and a function that returns the
    state of a frame from its index.

    reference_distance: metres from a lamp at which its flare has the strength of `FrameState.strengths`; it falls with
    the square of the distance. fixed_camera: whether the camera neither moves nor turns.
    """

    camera: Pinhole
    lens: str
    quads: list[Quad]
    ambient: Array
    frame_state: Callable[[int], FrameState]
    reference_distance: float
    fixed_camera: bool = False


def _to_albedo(texture: Pixels, dim: float = 1.0) -> Pixels:
    """Return the linear reflectance, at most 0.85 * dim, of a texture of display values."""
    return np.asarray(linear_from_srgb(np.clip(texture, 0, 1)) * np.float32(0.85 * dim), np.float32)


def _plain_texture(*colour: float) -> Pixels:
    return np.broadcast_to(np.array(colour, np.float32), (2, 2, 3)).copy()


def _random_camera(rng: np.random.Generator) -> Pinhole:
    focal = rng.uniform(375, 440)
    return Pinhole(WIDTH, HEIGHT, focal, focal, WIDTH / 2 + rng.uniform(-2, 2), HEIGHT / 2 + rng.uniform(-2, 2))


def _make_walker(rng: np.random.Generator, height: float, shirt: Sequence[float]) -> list[Quad]:
    """Return a figure that stands on y = 0 at the origin, made of boxes. height: metres. shirt: linear R G B."""
    trousers = _to_albedo(patterns.weave(rng, 64, 48, patterns.PLUM), 0.4)
    boxes = [((-0.2, -0.48 * height, -0.12), (0.2, 0, 0.12), trousers),
             ((-0.25, -0.84 * height, -0.14), (0.25, -0.48 * height, 0.14), _plain_texture(*shirt)),
             ((-0.1, -height, -0.1), (0.1, -0.86 * height, 0.1), _plain_texture(0.4, 0.25, 0.18))]
    return [side for low, high, texture in boxes for side in box_sides(low, high, texture)]


def _yaw_rotation(angle: float) -> Array:
    """Return (3, 3) world to camera of a camera turned to the right by `angle` radians."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])


def _pitch_rotation(angle: float) -> Array:
    """Return (3, 3) of a camera turned down by `angle` radians."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def torch_shot(seed: int) -> ShotScene:
    """Return the shot of a locked-off camera in a room in which somebody carries a torch about."""
    rng = np.random.default_rng((seed, 1))
    camera = _random_camera(rng)
    wall = patterns.poster(rng, 300, 700, patterns.STONE, 30) * 0.6 + 0.1
    wall += 0.3 * patterns.noise(rng, 300, 700, 40)[..., None]
    room = [quad((-6, -3, 7), (12, 0, 0), (0, 4.2, 0), _to_albedo(wall)),
            quad((-6, 1.2, 1), (12, 0, 0), (0, 0, 6), _to_albedo(patterns.planks(rng, 300, 600, patterns.WARM))),
            quad((-4.6, -3, 1), (0, 0, 6), (0, 4.2, 0), _to_albedo(patterns.tiles(rng, 200, 300, patterns.SEA, 8, 12))),
            quad((4.6, -3, 1), (0, 0, 6), (0, 4.2, 0), _to_albedo(patterns.marble(rng, 200, 300, patterns.STONE)))]
    for left in (-3.4, -0.4, 2.2):
        picture = patterns.framed(patterns.poster(rng, 160, 220, patterns.MOSS, 40))
        room.append(quad((left, -1.7, 6.98), (1.7, 0, 0), (0, 1.2, 0), _to_albedo(picture)))
    # A window, bright but no lamp.
    window = np.clip(0.8 + 0.4 * patterns.noise(rng, 40, 60, 12), 0, 1)[..., None] * np.array([0.9, 1.0, 1.1])
    room.append(quad((-1.2 + rng.uniform(-1.5, 2.0), -2.4, 6.96), (1.1, 0, 0), (0, 0.5, 0),
                     window.astype(np.float32), 1.15))
    screen_left = rng.uniform(-1.3, 0.6)  # left edge of the screen that hides the torch at times
    weave = _to_albedo(patterns.weave(rng, 200, 120, patterns.SEA))
    room += box_sides((screen_left, -0.9, 3.1), (screen_left + 0.75, 1.2, 3.25), weave)
    room += box_sides((1.5, 0.3, 4.4), (2.6, 1.2, 5.2), _to_albedo(patterns.planks(rng, 120, 160, patterns.WARM), 0.7))
    walker = _make_walker(rng, 1.8, (0.88, 0.87, 0.85))
    # phase, period: of the torch's path; period in frames. direction: the side the walker comes from, -1 left, 1 right.
    # start_x: metres from the middle at which the walker starts.
    phase, period, direction = rng.uniform(0, 2 * np.pi, 4), rng.uniform(26, 34), rng.choice([-1.0, 1.0])
    colour = np.array([1.0, 0.9, 0.75]) if seed % 2 else np.array([0.85, 0.95, 1.0])
    start_x = rng.uniform(2.4, 3.0)

    def state(index: int) -> FrameState:
        """Return frame `index`: the torch on a winding path, and the walker, who crosses steadily."""
        angle = 2 * np.pi * index / period
        torch_xyz = np.array([2.25 * np.sin(angle + phase[0]) + 0.35 * np.sin(2.3 * angle + phase[1]),
                              -0.25 + 0.62 * np.sin(1.6 * angle + phase[2]),
                              4.3 + 0.7 * np.sin(0.8 * angle + phase[3])])
        offset = np.array([direction * (start_x - 0.15 * index), 1.2, 2.3 + 0.004 * index])
        walker_sides = [side.moved(offset) for side in walker]
        lamp = Lamp(torch_xyz, 0.055, colour, 60.0, 4.0)
        return FrameState(np.zeros(3), np.eye(3), walker_sides, {"torch": lamp}, {"torch": 0.75})

    return ShotScene(camera, ("fast", "ringed")[seed % 2], room, np.array([0.22, 0.21, 0.23]), state, 4.3, True)


def drive_shot(seed: int) -> ShotScene:
    """Return the shot of a drive through a street at dusk; the right headlight of an oncoming car fails for a while."""
    rng = np.random.default_rng((seed, 2))
    camera = _random_camera(rng)
    street = [quad((-60, -70, 90), (120, 0, 0), (0, 72, 0), _plain_texture(0.5, 0.42, 0.45), 0.28),
              quad((-3.6, 1.3, 1), (7.2, 0, 0), (0, 0, 88), _road_texture(rng))]
    for side in (-1, 1):
        pavement = _to_albedo(patterns.tiles(rng, 600, 60, patterns.STONE, 80, 4), 0.7)
        street.append(quad((3.6 * side, 1.15, 1), (2.4 * side, 0, 0), (0, 0, 88), pavement))
        for house in range(8):
            front = patterns.facade(rng, 200, 220, (patterns.WARM, patterns.STONE, patterns.PLUM)[house % 3], 3, 4)
            front_z, height = 4 + 10 * house, rng.uniform(7, 11)
            street.append(quad((6 * side, 1.2 - height, front_z), (0, 0, 9.4), (0, height, 0), _to_albedo(front, 0.8)))
            for _ in range(int(rng.integers(0, 3))):
                window_z, window_top = front_z + rng.uniform(1, 7), 1.2 - rng.uniform(2.4, height - 1.2)
                street.append(quad((5.98 * side, window_top, window_z), (0, 0, 0.9), (0, 1.1, 0),
                                   _plain_texture(1.0, 0.8, 0.5), float(rng.uniform(0.5, 1.25))))
    car = box_sides((-0.85, -0.15, 0), (0.85, 0.95, 3.6), _plain_texture(0.05, 0.06, 0.09))
    car += box_sides((-0.7, -0.65, 0.9), (0.7, -0.15, 2.9), _plain_texture(0.03, 0.035, 0.04))
    colour = np.array([1.0, 0.93, 0.78]) if seed % 2 == 0 else np.array([0.88, 0.94, 1.0])
    # By frame: jitter of the camera's place, shake of its direction, flicker of the headlight. Of the car: the x of its
    # lane, the frame in which the headlight goes out, its distance in the first frame and its approach per frame.
    jitter, lane = rng.normal(size=(FRAMES, 3)) * (0.012, 0.012, 0.0), rng.uniform(-1.9, -1.5)
    shake = np.cumsum(rng.normal(size=(FRAMES, 2)), 0) * 0.0012
    out_frame = int(rng.integers(17, 21))
    flicker = rng.uniform(0.35, 0.95, FRAMES)
    start_distance = rng.uniform(21, 25)
    approach = (start_distance - rng.uniform(6.2, 8.0)) / FRAMES

    def state(index: int) -> FrameState:
        """Return frame `index`: the camera, which drives 0.22 m in a frame, the other car, and its two headlights."""
        eye = np.array([1.4, 0.0, 0.22 * index]) + jitter[index]
        car_z = start_distance + 0.22 * index - approach * index  # the camera drives 0.22 a frame
        sway = 0.12 * np.sin(index / 5)
        offset = np.array([lane + sway, 0.3, car_z])
        car_sides = [side_of_car.moved(offset) for side_of_car in car]
        # The right headlight flickers for 6 frames before it is out and for 4 after.
        is_out = out_frame <= index < out_frame + OUT_FRAMES
        flickers = out_frame - 6 <= index < out_frame or out_frame + OUT_FRAMES <= index < out_frame + OUT_FRAMES + 4
        brightness = {"left": 1.0, "right": 0.0 if is_out else float(flicker[index]) if flickers else 1.0}
        lamps = {name: Lamp(offset + np.array([0.66 * side, 0.42, -0.06]), 0.085, colour, 70.0 * brightness[name],
                            14.0 * brightness[name], np.array([0.0, 0.08, -1.0]))
                 for name, side in (("left", -1.0), ("right", 1.0))}
        rotation = _pitch_rotation(float(shake[index, 1])) @ _yaw_rotation(float(-0.06 + shake[index, 0]))
        return FrameState(eye, rotation, car_sides, lamps, {name: 0.5 * value for name, value in brightness.items()})

    return ShotScene(camera, ("anamorphic", "wide")[seed % 2], street, np.array([0.20, 0.20, 0.25]), state, 11.0)


def _road_texture(rng: np.random.Generator) -> Pixels:
    """Return a road with a broken line in its middle, along the rows."""
    road = _to_albedo(0.35 + 0.2 * patterns.noise(rng, 900, 90, 60)[..., None].repeat(3, 2), 0.9)
    for row in range(0, 900, 60):
        road[row:row + 30, 43:47] = (0.6, 0.6, 0.55)
    return road


def pan_shot(seed: int) -> ShotScene:
    """Return the shot of a camera that turns past a lamp on a stand from side to side; a walker and a cart cross."""
    rng = np.random.default_rng((seed, 3))
    camera = _random_camera(rng)
    floor = patterns.tiles(rng, 400, 600, patterns.STONE, 16, 28)
    square = [quad((-14, 1.5, 1), (28, 0, 0), (0, 0, 16), _to_albedo(floor))]
    for left in range(-14, 14, 4):
        front = patterns.facade(rng, 240, 200, (patterns.SEA, patterns.WARM, patterns.MOSS)[(left // 4) % 3], 3, 3)
        square.append(quad((left, -4.5, 12 + 0.4 * (left % 3)), (3.9, 0, 0), (0, 6, 0), _to_albedo(front)))
    for side in (-14, 14):
        front = patterns.facade(rng, 200, 400, patterns.STONE, 3, 6)
        square.append(quad((side, -4.5, 0.5), (0, 0, 13), (0, 6, 0), _to_albedo(front)))
    square.append(quad((-40, -30, 24), (80, 0, 0), (0, 32, 0), _plain_texture(0.75, 0.85, 1.0), 1.05))
    lamp_xyz = np.array([rng.uniform(0.4, 1.0), -1.0 + rng.uniform(-0.2, 0.2), 6.0])
    lamp_x, lamp_y, lamp_z = lamp_xyz
    square += box_sides((lamp_x - 0.05, lamp_y + 0.16, 6.0), (lamp_x + 0.05, 1.5, 6.1),
                        _plain_texture(0.04, 0.04, 0.05))
    posters = [_to_albedo(patterns.poster(rng, height, width, palette, 40))
               for height, width, palette in ((140, 160, patterns.WARM), (160, 120, patterns.PLUM),
                                              (120, 120, patterns.SEA))]
    square += box_sides((-4.2, 0.2, 7.5), (-2.6, 1.5, 8.6), posters[0])
    square += box_sides((3.2, -0.4, 8.2), (4.4, 1.5, 9.0), posters[1])
    cart = box_sides((-0.6, -2.7, 0), (0.6, 0, 0.8), posters[2])
    walker = _make_walker(rng, 2.6, (0.9, 0.9, 0.88))
    colour = np.array([1.0, 0.82, 0.58]) if seed % 2 == 0 else np.array([1.0, 0.95, 0.9])
    # max_angle: radians that the camera turns to either side. crossing_frames: in which walker and cart hide the lamp.
    direction, crossing_frames = rng.choice([-1.0, 1.0]), rng.uniform((12, 20), (16, 24))
    max_angle = rng.uniform(0.50, 0.58)
    shake = np.cumsum(rng.normal(size=(FRAMES, 2)), 0) * 0.0006

    def state(index: int) -> FrameState:
        """Return frame `index`: the camera turned to its angle, walker and cart in their places, and the lamp."""
        progress = index / (FRAMES - 1)
        angle = direction * max_angle * np.cos(np.pi * (progress * 1.15 - 0.05)) + 0.12 + shake[index, 0]
        rotation = _pitch_rotation(float(-0.05 + shake[index, 1])) @ _yaw_rotation(float(angle))
        moving = []
        for sides, depth, step, crossing_frame in ((walker, 4.6, 0.11, crossing_frames[0]),
                                                   (cart, 5.0, -0.22, crossing_frames[1])):
            # In its crossing frame a thing is on the line of sight to the lamp.
            x = lamp_x * depth / lamp_z + step * (index - crossing_frame)
            moving += [side.moved(np.array([x, 1.5, depth])) for side in sides]
        lamp = Lamp(lamp_xyz, 0.13, colour, 50.0, 5.0)  # radius, colour, radiance, power
        return FrameState(np.zeros(3), rotation, moving, {"lamp": lamp}, {"lamp": 0.7})  # strength of its flare

    return ShotScene(camera, ("wide", "fast")[seed % 2], square, np.array([0.36, 0.37, 0.40]), state, 6.2)


SHOTS: dict[str, Callable[[int], ShotScene]] = {"torch": torch_shot, "drive": drive_shot, "pan": pan_shot}
"""The shots by name; each makes its scene from a seed."""
