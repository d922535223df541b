"""`nexwarp view`."""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from nexwarp.cli.device import pick_device
from nexwarp.cli.options import Device_, Host_, Port_, Run_, option
from nexwarp.errors import FormatError
from nexwarp.export.web.export import web_page
from nexwarp.model.detail import check_detail
from nexwarp.model.model_file import load
from nexwarp.run.folder import keep_camera_path
from nexwarp.run.opened import OpenedModel, near_depth, open_model

if TYPE_CHECKING:
    from nexwarp.viewer import GradualModel, Viewer

FIRST_DETAIL = 0.05  # share of the surfels of the first pictures of a large model
LARGE = 20_000_000  # bytes of a model's file


@dataclass
class ViewCommand:
    """Show a run or a model in the browser, with all buffers and an editor of camera paths (extra `viewer`)."""

    run: Run_
    """Run folder, or a model's folder or .safetensors file."""
    host: Host_ = "127.0.0.1"
    """Address to listen on; 0.0.0.0 allows other machines, with the token of the URL that is printed."""
    port: Port_ = 8080
    """Port to listen on; 0 picks a free one."""
    detail: Annotated[float, option("SHARE")] = 1.0
    """Share of the surfels to show, above 0 to 1, as of nexwarp render; a large model first appears at 0.05."""
    device: Device_ = None
    """Device to render on."""

    def __call__(self, console: Console) -> None:
        """Serve the viewer until Ctrl-C."""
        from nexwarp.viewer import Viewer

        check_detail("--detail", self.detail)
        opened = open_model(self.run)
        model = self._model(opened)
        named = {name: camera for views in opened.cameras.values() for name, camera in views.items()}
        with Viewer(
            model,
            opened.cameras,
            near=near_depth(model()),
            title=opened.title,
            host=self.host,
            port=self.port,
            save_path=partial(keep_camera_path, opened.folder, opened=self.run),
            make_page=lambda: web_page(model.whole(), named, opened.title),
        ) as viewer:
            model.read_rest(viewer.redraw)
            show_until_interrupted(viewer, console)

    def _model(self, opened: OpenedModel) -> "GradualModel":
        """Return the model to show; of a large file with ordered surfels, the coarse part first."""
        from nexwarp.viewer import GradualModel

        device = pick_device(self.device)
        if self.detail == 1.0 and opened.file.is_file() and opened.file.stat().st_size > LARGE:
            with suppress(FormatError):  # surfels in no order, or a damaged file, which the last line names
                return GradualModel(load(opened.file, detail=FIRST_DETAIL).to(device), lambda: opened.model.to(device))
        return GradualModel(opened.model_at(self.detail, device))


def print_url(viewer: "Viewer", console: Console, more: str = "") -> None:
    """Print the viewer's address on one line, exactly: it may hold a token, or brackets."""
    console.print(f"viewer: {viewer.url}{more}", soft_wrap=True, markup=False)


def show_until_interrupted(viewer: "Viewer", console: Console) -> None:
    """Serve the viewer of a finished model until Ctrl-C."""
    print_url(viewer, console, " (Ctrl-C ends it)")
    with suppress(KeyboardInterrupt):
        viewer.show()
