"""Textures of landmarks: posters, doors, book spines, windows, boards, screens and parcels, drawn from a random generator."""

from __future__ import annotations

import cv2
import numpy as np

from hybridmap.simulation.paints import Color, Image, Rng, Shape, any_color, material, smooth_noise, tint, vary, wood


def _blank(shape: Shape, color: Color) -> Image:
    return np.full((*shape, 3), color, dtype=np.uint8)


def _text_lines(rng: Rng, image: Image, box: tuple[int, int, int, int], line_px: int, ink: Color) -> None:
    """Draw lines of words as bars into `box` (left, top, right, bottom)."""
    left, top, right, bottom = box
    for row in range(top, bottom - line_px, 2 * line_px):
        column = left
        end = right - int(rng.uniform(0, 0.4) * (right - left))
        while column < end:
            word = int(rng.integers(2, 9)) * max(1, line_px // 2)
            cv2.rectangle(image, (column, row), (min(column + word, right), row + line_px - 1), ink, -1)
            column += word + max(1, line_px)


def _photo(rng: Rng, shape: Shape) -> Image:
    """An abstract picture: colour clouds under some shapes."""
    height, width = shape
    channels = [128 + 70 * smooth_noise(rng, shape, max(2.0, 0.3 * width)) for _ in range(3)]
    image = np.ascontiguousarray(np.clip(np.stack(channels, axis=-1), 0, 255).astype(np.uint8))
    for _ in range(int(rng.integers(5, 11))):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        size = max(2, int(rng.uniform(0.06, 0.25) * width))
        kind = int(rng.integers(3))
        if kind == 0:
            cv2.circle(image, center, size, any_color(rng), -1, cv2.LINE_AA)
        elif kind == 1:
            corner = (center[0] + int(rng.integers(2, 2 * size + 2)), center[1] + int(rng.integers(2, 2 * size + 2)))
            cv2.rectangle(image, center, corner, any_color(rng), -1)
        else:
            points = np.array(center) + rng.integers(-size, size + 1, (3, 2))
            cv2.fillPoly(image, [points.astype(np.int32)], any_color(rng), cv2.LINE_AA)
    return image


@material
def poster(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`poster()` returns a paint that draws a poster, title, picture and text.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    paper = vary(rng, (235, 230, 215), 20) if rng.random() < 0.6 else any_color(rng, 60, 220)
    image = _blank(shape, paper)
    ink = any_color(rng, 0, 90)
    margin, line = max(2, width // 14), max(2, round(0.018 * px_per_m))
    cv2.rectangle(image, (0, 0), (width - 1, height // 6), any_color(rng, 10, 160), -1)
    _text_lines(rng, image, (margin, height // 20, width - margin, height // 6), 2 * line, vary(rng, (240, 240, 235), 15))
    top, low = height // 5, int(height * rng.uniform(0.5, 0.68))
    image[top:low, margin : width - margin] = _photo(rng, (low - top, width - 2 * margin))
    middle = width // 2
    _text_lines(rng, image, (margin, low + 2 * line, middle - line, height - margin), line, ink)
    _text_lines(rng, image, (middle + line, low + 2 * line, width - margin, height - margin), line, ink)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), any_color(rng, 0, 120), max(1, round(0.012 * px_per_m)))
    return image


@material
def painting(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`painting()` returns a paint that draws a framed picture.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    frame = max(2, round(0.04 * px_per_m))
    image = _blank(shape, any_color(rng, 20, 110))
    image[frame:-frame, frame:-frame] = _photo(rng, (shape[0] - 2 * frame, shape[1] - 2 * frame))
    return image


@material
def door(rng: Rng, shape: Shape, px_per_m: float, color: Color = (142, 104, 72)) -> Image:
    """`door(color)` returns a paint that draws a closed door with handle and plate.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    turned = wood(vary(rng, color, 14))(rng, (width, height), px_per_m)
    image = np.ascontiguousarray(np.rot90(turned))
    frame = max(2, round(0.06 * px_per_m))
    cv2.rectangle(image, (0, 0), (width - 1, height + frame), vary(rng, (88, 84, 80), 10), 2 * frame)
    side = 1 if rng.random() < 0.5 else -1
    handle = (width // 2 + side * int(0.36 * width), int(0.52 * height))
    cv2.circle(image, handle, max(2, round(0.03 * px_per_m)), (205, 205, 200), -1, cv2.LINE_AA)
    cv2.line(image, handle, (handle[0] - side * round(0.12 * px_per_m), handle[1]), (205, 205, 200), max(2, frame // 3))
    left, top = int(width * rng.uniform(0.3, 0.55)), int(0.16 * height)
    plate = (left + round(0.22 * px_per_m), top + round(0.1 * px_per_m))
    cv2.rectangle(image, (left, top), plate, vary(rng, (230, 228, 220), 20), -1)
    label = str(int(rng.integers(100, 1000)))
    cv2.putText(
        image, label, (left + 3, plate[1] - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.0034 * px_per_m, (20, 20, 25), 2, cv2.LINE_AA
    )
    if rng.random() < 0.6:
        size = (round(0.3 * px_per_m), round(0.21 * px_per_m))
        left, top = int(width * rng.uniform(0.2, 0.5)), int(height * rng.uniform(0.28, 0.4))
        room = image[top : top + size[0], left : left + size[1]]
        room[:] = poster()(rng, (room.shape[0], room.shape[1]), px_per_m)
    return image


@material
def books(rng: Rng, shape: Shape, px_per_m: float, shelves: int = 5) -> Image:
    """`books(shelves)` returns a paint that draws a book case with so many shelves.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    image = _blank(shape, (46, 38, 32))
    board = max(2, round(0.025 * px_per_m))
    frame = vary(rng, (128, 96, 66), 14)
    pitch = height // shelves
    for shelf in range(shelves):
        floor = (shelf + 1) * pitch - board
        column = board
        while column < width - board:
            thick = max(2, round(rng.uniform(0.02, 0.065) * px_per_m))
            if rng.random() < 0.1:
                column += 3 * thick
                continue
            tall = int(rng.uniform(0.55, 0.92) * (pitch - board))
            spine = any_color(rng, 25, 225)
            cv2.rectangle(image, (column, floor - tall), (min(column + thick - 1, width - board), floor), spine, -1)
            label = floor - int(tall * rng.uniform(0.3, 0.8))
            cv2.rectangle(image, (column, label), (column + thick - 1, label + max(1, tall // 8)), any_color(rng, 60, 245), -1)
            column += thick
        cv2.rectangle(image, (0, floor), (width - 1, floor + board), frame, -1)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), frame, 2 * board)
    return image


@material
def window(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`window()` returns a paint that draws a window with a view of sky and houses.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    fall = np.linspace(1.0, 1.12, height, dtype=np.float32)[:, None] + 0.03 * smooth_noise(rng, shape, 0.4 * px_per_m)
    image = np.ascontiguousarray(tint((178, 202, 226), fall))
    column = 0
    while column < width:
        wide, tall = int(rng.uniform(0.2, 0.5) * px_per_m), int(rng.uniform(0.2, 0.6) * height)
        wall = any_color(rng, 90, 190)
        cv2.rectangle(image, (column, height - tall), (column + wide, height), wall, -1)
        pane = max(2, wide // 7)
        for row in range(height - tall + pane, height, 2 * pane):
            for left in range(column + pane, column + wide - pane, 2 * pane):
                cv2.rectangle(image, (left, row), (left + pane - 1, row + pane - 1), vary(rng, (60, 70, 90), 30), -1)
        column += wide
    bar = max(2, round(0.05 * px_per_m))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (228, 228, 224), 2 * bar)
    for part in range(1, max(2, round(width / (0.9 * px_per_m)))):
        middle = part * width // max(2, round(width / (0.9 * px_per_m)))
        cv2.rectangle(image, (middle - bar // 2, 0), (middle + bar // 2, height), (228, 228, 224), -1)
    return image


@material
def whiteboard(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`whiteboard()` returns a paint that draws a white board with writing and a diagram.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    image = _blank(shape, (238, 240, 240))
    inks: tuple[Color, ...] = ((30, 60, 160), (170, 40, 40), (30, 110, 60), (30, 30, 35))
    for _ in range(int(3 + 5 * width / px_per_m)):
        ink = inks[int(rng.integers(len(inks)))]
        start = np.array([rng.uniform(0.05, 0.9) * width, rng.uniform(0.08, 0.9) * height])
        steps = rng.normal((0.02 * px_per_m, 0), 0.05 * px_per_m, (int(rng.integers(4, 14)), 2))
        points = (start + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(image, [points], bool(rng.random() < 0.3), ink, max(1, round(0.012 * px_per_m)), cv2.LINE_AA)
    for _ in range(4):
        left, top = int(rng.uniform(0.05, 0.7) * width), int(rng.uniform(0.05, 0.7) * height)
        far = (left + int(0.25 * width), top + int(0.2 * height))
        _text_lines(rng, image, (left, top, *far), max(2, round(0.02 * px_per_m)), inks[int(rng.integers(len(inks)))])
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (120, 124, 128), max(2, round(0.03 * px_per_m)))
    return image


@material
def notice_board(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`notice_board()` returns a paint that draws a cork board with pinned papers.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    image = tint((176, 134, 88), 1.0 + 0.08 * rng.standard_normal(shape, dtype=np.float32))
    image = np.ascontiguousarray(image)
    for _ in range(int(7 * height * width / px_per_m**2) + 3):
        tall, wide = round(rng.uniform(0.15, 0.32) * px_per_m), round(rng.uniform(0.12, 0.3) * px_per_m)
        top, left = int(rng.integers(0, max(1, height - tall))), int(rng.integers(0, max(1, width - wide)))
        sheet = image[top : top + tall, left : left + wide]
        small = (sheet.shape[0], sheet.shape[1])
        if rng.random() < 0.4:
            sheet[:] = _photo(rng, small)
        else:
            page = _blank(small, vary(rng, (236, 232, 200), 28))
            _text_lines(rng, page, (3, 4, small[1] - 3, small[0] - 3), max(2, round(0.012 * px_per_m)), any_color(rng, 0, 110))
            sheet[:] = page
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (96, 70, 48), max(2, round(0.03 * px_per_m)))
    return image


@material
def screen(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`screen()` returns a paint that draws a computer screen.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    image = _blank(shape, any_color(rng, 20, 90))
    for _ in range(3):
        left, top = int(rng.uniform(0.03, 0.5) * width), int(rng.uniform(0.03, 0.5) * height)
        far = (left + int(rng.uniform(0.3, 0.5) * width), top + int(rng.uniform(0.3, 0.5) * height))
        cv2.rectangle(image, (left, top), far, vary(rng, (225, 228, 232), 25), -1)
        _text_lines(
            rng, image, (left + 2, top + 3, far[0] - 2, far[1] - 2), max(2, round(0.012 * px_per_m)), any_color(rng, 0, 120)
        )
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (24, 24, 26), max(2, round(0.03 * px_per_m)))
    return image


@material
def parcel(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`parcel()` returns a paint that draws the side of a cardboard box.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    height, width = shape
    image = np.ascontiguousarray(tint(vary(rng, (176, 136, 92), 14), 1.0 + 0.04 * smooth_noise(rng, shape, 0.05 * px_per_m)))
    tape = max(2, round(0.05 * px_per_m))
    cv2.rectangle(image, (width // 2 - tape // 2, 0), (width // 2 + tape // 2, height // 3), (206, 184, 140), -1)
    left, top = int(rng.uniform(0.05, 0.5) * width), int(rng.uniform(0.35, 0.6) * height)
    far = (left + int(0.4 * width), top + int(0.3 * height))
    cv2.rectangle(image, (left, top), far, (236, 234, 228), -1)
    _text_lines(rng, image, (left + 2, top + 2, far[0] - 2, far[1] - 1), max(2, round(0.012 * px_per_m)), (25, 25, 30))
    mark = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.7, 0.95) * height))
    cv2.circle(image, mark, max(2, round(0.03 * px_per_m)), any_color(rng, 10, 120), -1, cv2.LINE_AA)
    return image


@material
def leaves(rng: Rng, shape: Shape, px_per_m: float) -> Image:
    """`leaves()` returns a paint that draws the foliage of a pot plant.

    Called with a generator, a shape (h, w) in texels and texels per metre, the paint returns (h, w, 3) uint8 RGB.
    """
    image = _blank(shape, (28, 52, 26))
    for _ in range(int(260 * shape[0] * shape[1] / px_per_m**2) + 8):
        center = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        axes = (max(2, round(rng.uniform(0.03, 0.07) * px_per_m)), max(1, round(0.018 * px_per_m)))
        green = (int(rng.integers(30, 110)), int(rng.integers(90, 190)), int(rng.integers(30, 80)))
        cv2.ellipse(image, center, axes, float(rng.uniform(0, 180)), 0, 360, green, -1, cv2.LINE_AA)
    return image
