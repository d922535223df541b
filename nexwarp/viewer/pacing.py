"""Choice of a picture's size from its predicted cost, and the share of training time spent on pictures."""

import math

STEP = math.sqrt(0.5)  # ratio of neighbouring scales
SMALLEST = 32  # pixels along the shorter side
MOVING_SECONDS = 0.08  # target time of a picture while the camera moves
TRAINING_SECONDS = 0.4  # largest time of a picture between two steps of a training
BAND_SECONDS = 0.2  # target time of a band of rows
MOST_PIXELS = 3840 * 2160  # of a picture, screenshots included
MOST_SIDE = 8192  # pixels, of a picture
FIRST_PIXELS = 2**18  # at most, of the first picture of a kind
BAND_PIXELS = 2**20  # at most, of a band of rows, unless 16 rows have more: bounds the memory of a rendering
FIRST_SECONDS = 1.0  # of the first picture of a kind that `Share` counts at most: it includes compilation
STILL_AFTER = 0.2  # seconds without a change after which a picture is refined


def limited(scale: float, width: int, height: int) -> float:
    """Reduce the scale of a picture of a window so that it has at most `MOST_PIXELS`, and `MOST_SIDE` a side."""
    return min(scale, math.sqrt(MOST_PIXELS / (width * height)), MOST_SIDE / max(width, height))


class Pace:
    """Estimates the time of a pixel for each kind of picture, and chooses the scale of the next picture from it."""

    def __init__(self) -> None:
        self.seconds_per_pixel: dict[object, float] = {}

    def observe(self, kind: object, pixels: int, seconds: float) -> None:
        """Update the estimate: at once to a lower one, else by a third, as the first picture includes compilation."""
        new = seconds / max(pixels, 1)
        old = self.seconds_per_pixel.get(kind, new)
        self.seconds_per_pixel[kind] = min(new, old + (new - old) / 3.0)

    def seconds(self, kind: object, pixels: float) -> float:
        """Predict the time of a picture in seconds; 0 for a kind that was never drawn."""
        return self.seconds_per_pixel.get(kind, 0.0) * pixels

    def bands(self, kind: object, pixels: float) -> int:
        """Return the number of bands of a picture, each of about `BAND_SECONDS` and of at most `BAND_PIXELS`."""
        return max(math.ceil(self.seconds(kind, pixels) / BAND_SECONDS), math.ceil(pixels / BAND_PIXELS), 1)

    def scale(self, kind: object, width: int, height: int, limit: float) -> float:
        """Return the largest scale of 1, 0.71, 0.5, ... at which a picture of a window should take `limit` seconds.

        The first picture of a kind is small. The shorter side has at least `SMALLEST` pixels.
        """
        floor = min(SMALLEST / max(min(width, height), 1), 1.0)
        if kind not in self.seconds_per_pixel:
            return max(min(0.25, math.sqrt(FIRST_PIXELS / (width * height))), floor)
        scale = 1.0
        while scale > floor and self.seconds(kind, width * height * scale**2) > limit:
            scale *= STEP
        return max(scale, floor)


class Share:
    """Limits the time spent on pictures to a share of all time, by a pause after each picture in proportion to it."""

    def __init__(self, share: float) -> None:
        self.share = share
        self.free_at = -math.inf

    def due(self, now: float) -> bool:
        """Whether a picture may start at `now`, in seconds."""
        return now >= self.free_at

    def spend(self, now: float, seconds: float) -> None:
        """Count a picture of this duration that ended at `now`."""
        self.free_at = now + seconds * (1.0 - self.share) / self.share
