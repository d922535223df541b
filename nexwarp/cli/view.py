"""`nexwarp view`."""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from rich.console import Console

from nexwarp.cameras.cameras_file import CAMERAS_FILE, load_cameras
from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Host_, Port_, Run_
from nexwarp.model.model_file import load
from nexwarp.run.export import run_title
from nexwarp.run.folder import keep_camera_path, read_run
from nexwarp.web.export import web_page

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


@dataclass
class ViewCommand:
    """Show a run in the browser, with all buffers and an editor of camera paths for render (extra `viewer`)."""

    run: Run_
    """Run folder."""
    host: Host_ = "127.0.0.1"
    """Address to listen on; 0.0.0.0 allows other machines, with the token of the URL that is printed."""
    port: Port_ = 8080
    """Port to listen on; 0 picks a free one."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Serve the viewer until Ctrl-C."""
        from nexwarp.viewer import Viewer

        source, _, _ = read_run(self.run)
        model = load(self.run).to(pick_device(self.device))
        cameras = load_cameras(self.run / CAMERAS_FILE)
        named = {name: camera for views in cameras.values() for name, camera in views.items()}
        with Viewer(
            lambda: model,
            cameras,
            near=near if isinstance(near := model.meta.get("near"), float) else 0.01,
            title=source.name,
            host=self.host,
            port=self.port,
            save_path=partial(keep_camera_path, self.run),
            make_page=partial(web_page, model, named, run_title(source)),
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
