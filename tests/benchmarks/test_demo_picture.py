"""The README's picture shows what the model renders, each pass in its column."""

import torch

import nexwarp as nw
from benchmarks.demo_picture import CAPTIONS, GAP, draw_row
from nexwarp.data.views import View
from nexwarp.io.pictures import CAPTION_HEIGHT, to_uint8
from tests.scenes import make_camera, make_surfels, make_texture, random_scene


def test_columns_are_the_photo_and_the_passes_of_its_camera() -> None:
    scene = random_scene(8)
    camera, model = make_camera(scene).to(torch.float32), nw.Model(make_surfels(scene), make_texture())
    photo = torch.randint(0, 256, (camera.height, camera.width, 3), dtype=torch.uint8)
    row = draw_row(model, View(camera, photo, None, "photo.png"), CAPTIONS)
    assert row.shape == (camera.height + CAPTION_HEIGHT, 5 * camera.width + 4 * GAP, 3)
    columns = [row[CAPTION_HEIGHT:, i * (camera.width + GAP) :][:, : camera.width] for i in range(5)]
    with torch.no_grad():
        rendering = model.render(camera)
    assert columns[0].equal(photo)
    for column, expected in zip(columns[1:4], (rendering.image, rendering.plain, rendering.textured), strict=True):
        assert column.equal(to_uint8(expected))
    empty, heaviest = (columns[4] == 255).all(-1), rendering.ids[..., 0]
    assert empty.equal(heaviest < 0) and 0.0 < empty.float().mean() < 1.0
    for surfel in heaviest.unique()[1:]:
        assert len(columns[4][heaviest == surfel].unique(dim=0)) == 1
