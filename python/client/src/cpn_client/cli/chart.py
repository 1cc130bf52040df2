"""Picture of a plan."""

from collections.abc import Sequence

import PIL.Image
from PIL.ImageDraw import Draw, ImageDraw

from cpn_client.cli.pictures import picture
from cpn_client.image import SIZE, Image
from cpn_client.plan import Action

SIDE, CHART, MARGIN = 3 * SIZE, 5 * SIZE, 30
"""Side of an image and height of the chart, width of the chart, and space around them, in pixels."""
COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}


def draw(observation: Image, goal: Image, actions: Sequence[Action]) -> PIL.Image.Image:
    """Observation, goal, and a chart of the planned x, y and z over the steps, from -1 to 1 or as far as they go.

    Args:
        observation: Observation.
        goal: Goal.
        actions: [horizon, A], with x, y and z first.
    """
    canvas = PIL.Image.new("RGB", (2 * SIDE + CHART + 4 * MARGIN, SIDE + 2 * MARGIN), "white")
    pen = Draw(canvas)
    for left, title, image in ((MARGIN, "observation", observation), (2 * MARGIN + SIDE, "goal", goal)):
        pen.text((left, MARGIN / 2), title, "black")
        canvas.paste(picture(image).resize((SIDE, SIDE), PIL.Image.Resampling.NEAREST), (left, MARGIN))
    _chart(pen, 2 * SIDE + 3 * MARGIN, [action[:3] for action in actions])
    return canvas


def _chart(pen: ImageDraw, left: int, actions: Sequence[Action]) -> None:
    pen.text((left, MARGIN / 2), "planned action over steps:", "black")
    limit = max(1.0, *(abs(value) for action in actions for value in action))
    width, middle, scale = CHART / len(actions), MARGIN + SIDE / 2, SIDE / 2 / limit
    for value in (-limit, 0.0, limit):
        height = middle - scale * value
        pen.line((left, height, left + CHART, height), "lightgrey")
        pen.text((left - 4, height), f"{value:.1f}", "black", anchor="rm")
    for step in range(0, len(actions), 1 + len(actions) // 20):
        pen.text((left + width * (step + 0.5), SIDE + 1.5 * MARGIN), f"{step + 1}", "black", anchor="mm")
    for number, ((name, colour), values) in enumerate(zip(COLOURS.items(), zip(*actions, strict=True), strict=False)):
        points = [(left + width * (step + 0.5), middle - scale * value) for step, value in enumerate(values)]
        pen.line(points, colour, 2)
        for x, y in points:
            pen.ellipse((x - 3, y - 3, x + 3, y + 3), colour)
        pen.text((left + 140 + MARGIN * number, MARGIN / 2), name, colour)
