"""The README's picture shows what the model renders, each picture in its column."""

import torch

import nexwarp as nw
from benchmarks.picture import GAP, draw_row
from nexwarp.data.views import View
from nexwarp.io.pictures import CAPTION_HEIGHT, to_uint8
from tests.scenes import make_camera, make_surfels, make_texture, random_scene


def test_columns_are_the_photo_and_what_its_camera_sees() -> None:
    scene = random_scene(8)
    camera, model = make_camera(scene).to(torch.float32), nw.Model(make_surfels(scene), make_texture())
    photo = torch.randint(0, 256, (camera.height, camera.width, 3), dtype=torch.uint8)
    row = draw_row(model, View(camera, photo, None, "photo.png"))
    assert row.shape == (camera.height + CAPTION_HEIGHT, 4 * camera.width + 3 * GAP, 3)
    columns = [row[CAPTION_HEIGHT:, i * (camera.width + GAP) :][:, : camera.width] for i in range(4)]
    with torch.no_grad():
        rendering, plain = model.render(camera), model.render(camera, max_hits=0)
    assert columns[0].equal(photo)
    assert columns[1].equal(to_uint8(rendering.image)) and columns[2].equal(to_uint8(plain.image))
    empty, heaviest = (columns[3] == 255).all(-1), rendering.ids[..., 0]
    assert empty.equal(heaviest < 0) and 0.0 < empty.float().mean() < 1.0
    for surfel in heaviest.unique()[1:]:
        assert len(columns[3][heaviest == surfel].unique(dim=0)) == 1
