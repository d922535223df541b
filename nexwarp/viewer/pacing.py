"""How large a picture may be to come in time, and how much of a training's time may go into pictures."""

import math

STEP = math.sqrt(0.5)
SMALLEST = 32  # pixels along the shorter side
MOVING_SECONDS = 0.08
TRAINING_SECONDS = 0.4
BAND_SECONDS = 0.2
MOST_PIXELS = 3840 * 2160
LONGEST_WAIT = 1.0
STILL_AFTER = 0.2


class Pace:
    """Learns what a pixel costs, for each kind of picture, and sizes the next one by it.

    A cheaper measurement is believed at once, a dearer one by a third: the first picture of its kind also compiles.
    """

    def __init__(self) -> None:
        self.seconds_per_pixel: dict[object, float] = {}

    def observe(self, kind: object, pixels: int, seconds: float) -> None:
        """Take note of one picture."""
        new, old = seconds / max(pixels, 1), self.seconds_per_pixel.get(kind)
        self.seconds_per_pixel[kind] = new if old is None or new < old else old + (new - old) / 3.0

    def seconds(self, kind: object, pixels: float) -> float:
        """Predicted time of a picture; 0 for a kind not seen yet."""
        return self.seconds_per_pixel.get(kind, 0.0) * pixels

    def bands(self, kind: object, pixels: float) -> int:
        """How many parts to draw a picture in, so that each leaves room to look whether it is still wanted."""
        return max(math.ceil(self.seconds(kind, pixels) / BAND_SECONDS), 1)

    def scale(self, kind: object, width: int, height: int, limit: float) -> float:
        """Largest scale 1, 0.71, 0.5, ... of a window at which a picture takes at most `limit` seconds.

        An unknown kind starts at a quarter. Never so small that the shorter side falls below `SMALLEST`.
        """
        floor = min(SMALLEST / max(min(width, height), 1), 1.0)
        if kind not in self.seconds_per_pixel:
            return max(0.25, floor)
        scale = 1.0
        while scale > floor and self.seconds(kind, width * height * scale**2) > limit:
            scale *= STEP
        return max(scale, floor)


class Share:
    """Keeps the time spent on pictures at a share of all time: each is followed by a pause in proportion."""

    def __init__(self, share: float) -> None:
        self.share = share
        self.free_at = -math.inf

    def set(self, percent: float) -> None:
        """Set the share in percent, from 1 to 90; ValueError for what is no number."""
        if not math.isfinite(percent):
            raise ValueError(f"share: expected a number, got {percent}")
        self.share = min(max(percent / 100.0, 0.01), 0.9)

    def due(self, now: float) -> bool:
        """Whether there is time for a picture at `now`, in seconds."""
        return now >= self.free_at

    def spend(self, now: float, seconds: float) -> None:
        """Account for a picture that ended at `now`."""
        self.free_at = now + seconds * (1.0 - self.share) / self.share
