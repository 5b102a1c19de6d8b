"""Annotate a photograph with its evaluation."""

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.photograph import LookedAt, Photograph, TargetReading
from heliotrope.imaging.spots.placed import PlacedSpot

# Blue, green, red: bluish green, vermilion, sky blue, yellow of Okabe and Ito.
GOOD, BAD, FACE, OTHER = (115, 158, 0), (0, 94, 213), (233, 180, 86), (66, 228, 240)
#: Longer side of an annotated picture, pixels.
LONGEST = 1400
#: Radius of the 90 % ellipse of two dimensions, in standard deviations.
_NINETY = 2.146


def annotate(photograph: Photograph) -> Image:
    """Return the photograph with marks, outlines, spots, centroids and notes drawn on it.

    Returns
    -------
    The picture as blue, green, red, (H, W, 3), uint8; large photographs are scaled down. A spot is
    drawn as the outline of its pixels, its centroid, the one-sigma ellipse of its light and,
    filled, the 90 % ellipse of the centroid error.
    """
    sheet = _Sheet(photograph)
    for face in photograph.faces:
        sheet.outline(face)
    for reading in photograph.readings:
        sheet.marks(reading)
    for reading in photograph.readings:
        for k, spot in enumerate(reading.spots):
            sheet.spot(spot, (GOOD if reading.good else BAD) if k == 0 else OTHER)
    for spot in photograph.beside:
        sheet.spot(spot, OTHER)
    sheet.legend(photograph)
    return sheet.picture


class _Sheet:
    """A reduced copy of the frame to draw on."""

    def __init__(self, photograph: Photograph) -> None:
        import cv2

        frame = photograph.frame
        pixels = frame.pixels
        if pixels.dtype != np.uint8:
            # 12-bit values in 16 bits are common, so scale to the brightest pixel.
            top = max(int(pixels.max()), 1)
            pixels = (pixels.astype(np.float32) * (255.0 / top)).astype(np.uint8)
        if pixels.ndim == 2:
            pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        width, height = frame.size
        self.factor = min(1.0, LONGEST / max(width, height))
        if max(width, height) < LONGEST // 2:
            self.factor = float(LONGEST // 2 // max(width, height))
        size = (round(width * self.factor), round(height * self.factor))
        method = cv2.INTER_AREA if self.factor < 1.0 else cv2.INTER_NEAREST
        self.picture: Image = np.ascontiguousarray(cv2.resize(pixels, size, interpolation=method))
        self.faces = photograph.faces

    def at(self, pixels: FloatArray) -> Image:
        """Convert frame pixels to sixteenths of sheet pixels, for OpenCV's ``shift=4``."""
        place = (np.asarray(pixels) + 0.5) * self.factor - 0.5
        return np.round(16.0 * np.clip(place, -1e5, 1e5)).astype(np.int32)

    def frame_pixels(self, face: LookedAt, plane: FloatArray) -> FloatArray:
        """Return the frame pixels of positions in a face's plane; a crop has no view."""
        picture = face.picture
        if picture.view is not None:
            return picture.view.to_pixels(plane)
        rows = picture.shape[0]
        height = round(self.picture.shape[0] / self.factor)
        stretch = np.array([1.0, height / rows])
        return np.asarray((picture.pixels(plane) + 0.5) * stretch - 0.5)

    def line(self, points: FloatArray, colour: tuple[int, int, int], width: int = 1) -> None:
        import cv2

        cv2.polylines(
            self.picture, [self.at(points).reshape(-1, 1, 2)], True, colour, width, cv2.LINE_AA, 4
        )

    def outline(self, face: LookedAt) -> None:
        for target in face.picture.face.targets:
            corners = face.picture.face.plane(target.corners)
            # A lens bends straight lines.
            t = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None]
            sides = [
                a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
            ]
            self.line(self.frame_pixels(face, np.concatenate(sides)), FACE)

    def marks(self, reading: TargetReading) -> None:
        import cv2

        for mark in reading.found.marks:
            if not np.isfinite(mark.pixel).all():
                continue
            x, y = (self.at(mark.pixel) / 16.0).astype(int)
            colour = GOOD if mark.used else BAD
            cv2.drawMarker(self.picture, (int(x), int(y)), colour, cv2.MARKER_CROSS, 14, 2)
            if not mark.used:
                cv2.circle(self.picture, (int(x), int(y)), 12, colour, 1, cv2.LINE_AA)

    def spot(self, placed: PlacedSpot, colour: tuple[int, int, int]) -> None:
        import cv2

        face = next(
            f
            for f in self.faces
            if f.picture.shape == placed.spot.region.shape
            and (placed.target is None or placed.target in f.picture.face.targets)
        )
        contours = cv2.findContours(
            placed.spot.region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        for contour in contours[0]:
            border = face.picture.plane(contour.reshape(-1, 2).astype(np.float64))
            self.line(self.frame_pixels(face, border), colour)
        centre = placed.spot.centroid
        self.line(self.frame_pixels(face, _ellipse(centre, placed.spot.second_moments)), colour)
        sure = self.frame_pixels(face, _ellipse(centre, placed.covariance, _NINETY))
        cv2.fillPoly(self.picture, [self.at(sure).reshape(-1, 1, 2)], colour, cv2.LINE_AA, 4)
        x, y = (self.at(self.frame_pixels(face, centre)) / 16.0).astype(int)
        cv2.drawMarker(
            self.picture, (int(x), int(y)), (0, 0, 0), cv2.MARKER_TILTED_CROSS, 12, 1, cv2.LINE_AA
        )

    def legend(self, photograph: Photograph) -> None:
        """Write the result for each target below the picture."""
        import cv2

        lines = []
        present = [r for r in photograph.readings if r.found.found]
        # A camera sees few of a plant's targets, so missing targets matter only if all are missing.
        for reading in present or photograph.readings:
            colour = GOOD if reading.good else BAD
            lines += [(line, colour) for line in _said(reading)]
        if photograph.beside:
            lines.append((f"outside the targets: {len(photograph.beside)} spots", OTHER))
        scale, pitch = 0.5, 20
        width = self.picture.shape[1]
        most = max(width // 9, 20)
        wrapped = [
            (part, colour)
            for text, colour in lines
            for part in ([text[i : i + most] for i in range(0, len(text), most)] or [""])
        ]
        strip = np.full((pitch * len(wrapped) + 10, width, 3), 20, dtype=np.uint8)
        for k, (text, colour) in enumerate(wrapped):
            where = (6, pitch * (k + 1) - 4)
            # OpenCV's font contains only ASCII characters.
            plain = text.encode("ascii", "replace").decode()
            light = tuple(min(255, c + 70) for c in colour)
            cv2.putText(strip, plain, where, cv2.FONT_HERSHEY_SIMPLEX, scale, light, 1, cv2.LINE_AA)
        self.picture = np.concatenate([self.picture, strip])


def _said(reading: TargetReading) -> list[str]:
    name = reading.found.target.name
    if not reading.found.found:
        return [f"{name}: not found: {reading.found.reason}"]
    if not reading.spots:
        return [f"{name}: no spot"]
    spot = reading.spots[0]
    side, up = np.sqrt(np.diag(spot.covariance))
    text = (
        f"{name}: {spot.plane[0]:+.3f} m right, {spot.plane[1]:+.3f} m up "
        f"(+-{1e3 * side:.0f}, {1e3 * up:.0f} mm)"
    )
    if len(reading.spots) > 1:
        text += f", {len(reading.spots) - 1} more"
    return [text, *(f"   {r.name}: {r.text}" for r in reading.reasons)]


def _ellipse(centre: FloatArray, covariance: FloatArray, radius: float = 1.0) -> FloatArray:
    """Return 64 points (64, 2) on the ellipse of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.arange(64) * (2.0 * np.pi / 64)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(
        centre + radius * (vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T
    )
