"""What the lessons share. The import also puts the folder of the four modules on the path."""

import io
import os
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import PIL.Image
from IPython.display import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from loco_mtrl import draw_map  # noqa: E402

SHORT = bool({"CI", "PYTEST_CURRENT_TEST"} & os.environ.keys())  # under test: a short form will do
FRAME = 0.2  # s between two frames of a film


def walk(env, act, seed, seconds=60, **options):
    """One episode, step by step: yields (observation, reward, info), at first of the reset.

    act: observation -> action. options: which terrain and route, see LocoEnv.reset.
    """
    observation, info = env.reset(seed=seed, options=options)
    reward, ended = 0.0, False
    yield observation, reward, info
    while not ended and env.unwrapped.seconds < seconds - 1e-6:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        ended = terminated or truncated
        yield observation, reward, info


def film(env, act, seed, seconds=60, start=0.0, **options):
    """Camera frames of one episode, every FRAME s from `start` s on, and its last info."""
    frames = []
    for _, _, info in walk(env, act, seed, seconds, **options):  # noqa: B007
        if env.unwrapped.seconds > start + FRAME * len(frames) - 1e-6:
            frames.append(env.render())
    return frames, info


def gif(frames):
    """Camera frames as an animation in real time."""
    pictures = [PIL.Image.fromarray(frame) for frame in frames]
    for picture in pictures:
        # A lesson with its pictures is to stay under 1 MB.
        picture.thumbnail((420, 225), PIL.Image.Resampling.NEAREST)
    pictures = [picture.quantize(64, dither=0) for picture in pictures]
    file = io.BytesIO()
    pictures[0].save(file, "gif", save_all=True, append_images=pictures[1:], loop=0,
                     duration=round(1000 * FRAME))
    return Image(file.getvalue(), format="gif")


def show_maps(terrains, columns=4):
    """Terrains from above, {title: Terrain}; returns the axes, one each."""
    rows = -(-len(terrains) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(13, 9 / columns * rows), squeeze=False,
                                layout="constrained", dpi=70)
    axes = axes.ravel()
    for axis, (title, terrain) in zip(axes, terrains.items(), strict=False):
        draw_map(axis, terrain)
        axis.set_title(title, fontsize=9)
    for axis in axes[len(terrains):]:
        axis.remove()
    return axes[:len(terrains)]
