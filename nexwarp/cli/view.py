"""`nexwarp view`."""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from rich.console import Console

from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Host_, Port_, Run_
from nexwarp.run.folder import keep_camera_path
from nexwarp.run.opened import near_depth, open_model

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


@dataclass
class ViewCommand:
    """Show a run or a model in the browser, with all buffers and an editor of camera paths (extra `viewer`)."""

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    host: Host_ = "127.0.0.1"
    """Address to listen on; 0.0.0.0 allows other machines, with the token of the URL that is printed."""
    port: Port_ = 8080
    """Port to listen on; 0 picks a free one."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Serve the viewer until Ctrl-C."""
        from nexwarp.viewer import Viewer, ViewerOptions

        opened = open_model(self.run)
        model = opened.model.to(pick_device(self.device))
        with Viewer(
            lambda: model,
            opened.cameras,
            ViewerOptions(near_depth(model), opened.title, self.host, self.port),
            save_path=partial(keep_camera_path, opened.folder, opened=self.run, origin=model.origin),
        ) as viewer:
            show_until_interrupted(viewer, console)


def print_url(viewer: "Viewer", console: Console, more: str = "") -> None:
    """Print the viewer's address on one line, exactly: it may hold a token, or brackets."""
    console.print(f"viewer: {viewer.url}{more}", soft_wrap=True, markup=False)


def show_until_interrupted(viewer: "Viewer", console: Console) -> None:
    """Serve the viewer of a finished model until Ctrl-C."""
    print_url(viewer, console, " (Ctrl-C ends it)")
    with suppress(KeyboardInterrupt):
        viewer.show()
