"""A model that is shown coarsely at once, and wholly as soon as it is read."""

import logging
import threading
from collections.abc import Callable

from nexwarp.model.model import Model

log = logging.getLogger(__name__)


class GradualModel:
    """Returns a coarse model until a thread has read the whole one.

    Attributes:
        current: the model that is returned now.
    """

    def __init__(self, first: Model, read: Callable[[], Model] | None = None) -> None:
        """Start with a model; `read` returns the whole one, None if `first` is it."""
        self.current, self.read = first, read
        self.thread: threading.Thread | None = None

    def __call__(self) -> Model:
        """Return the current model."""
        return self.current

    def whole(self) -> Model:
        """Wait until the whole model is read, and return it; the coarse one if it could not be read."""
        if self.thread is not None:
            self.thread.join()
        return self.current

    def read_rest(self, ready: Callable[[], None]) -> threading.Thread | None:
        """Read the whole model in a thread, which then calls `ready`; None if there is nothing more to read."""
        if self.read is None:
            return None
        arguments = (self.read, ready)
        self.thread = threading.Thread(target=self._replace, args=arguments, name="read model", daemon=True)
        self.thread.start()
        return self.thread

    def _replace(self, read: Callable[[], Model], ready: Callable[[], None]) -> None:
        try:
            self.current = read()
        except (OSError, ValueError, RuntimeError, MemoryError) as error:
            log.warning("the viewer shows the coarse model only: %s", error)
            return
        ready()
