"""The bar of colours beside a picture."""

import numpy as np

PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"))
INK = (43, 52, 64, 255)


def width(width: int, height: int) -> int:
    """Pixels beside a picture of that size that the bar takes."""
    return min(width // 3, max(60, round(0.17 * height)))


def draw(title: str, unit: str, top: float, colors: str, size: tuple[int, int]) -> np.ndarray:
    """(height, width, 4) uint8: a bar from 0 to `top`, transparent around it. colors: the name of a colour map."""
    import pyvista
    from PIL import Image, ImageDraw, ImageFont

    width, height = size
    factor, prefix = next((pair for pair in PREFIXES if top >= pair[0]), PREFIXES[-1])
    text = max(9, round(0.15 * width))
    font = ImageFont.load_default(text)
    image = Image.new("RGBA", size, (*INK[:3], 0))
    pen = ImageDraw.Draw(image)
    lines = [*_wrapped(title, lambda line: pen.textlength(line, font), 0.92 * width), f"in {prefix}{unit}"]
    for number, line in enumerate(lines):
        pen.text((0.04 * width, round(0.05 * height) + 1.25 * text * number), line, INK, font)
    first, last = round(0.05 * height + 1.25 * text * (len(lines) + 1)), round(0.95 * height)
    left, right = round(0.06 * width), round(0.28 * width)
    ramp = pyvista.LookupTable(colors, n_values=256)
    shades = np.array([ramp.map_value(value) for value in np.linspace(1.0, 0.0, last - first)])
    bar = np.repeat((255.0 * shades / shades.max(initial=1.0)).astype(np.uint8)[:, None, :4], right - left, axis=1)
    image.paste(Image.fromarray(bar), (left, first))
    pen.rectangle((left, first, right, last), outline=INK)
    for value in ticks(top / factor):
        y = last - (last - first) * value * factor / top
        pen.line((right, y, right + 0.06 * width, y), INK)
        pen.text((right + 0.1 * width, y), f"{value:g}", INK, font, anchor="lm")
    return np.asarray(image)


def ticks(top: float) -> list[float]:
    """Round numbers from 0 up to `top`, four to ten of them."""
    power = 10.0 ** np.floor(np.log10(top / 4.0))
    step = power * max(digit for digit in (1.0, 2.0, 2.5, 5.0) if digit * power <= top / 4.0)
    return [float(np.round(step * k, 12)) for k in range(int(top / step * (1.0 + 1e-9)) + 1)]


def _wrapped(text: str, length, most: float) -> list[str]:
    lines: list[str] = []
    for word in text.split():
        if lines and length(f"{lines[-1]} {word}") <= most:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines
