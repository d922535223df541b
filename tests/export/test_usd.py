import dataclasses
import io
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.cameras.similarity import upright
from nexwarp.errors import FormatError
from nexwarp.export.glb import bake_cards, quads
from nexwarp.export.mesh import Mesh
from nexwarp.export.splats import gaussians
from nexwarp.export.usd import save_usdz
from nexwarp.io.pictures import to_uint8
from nexwarp.kernels.sh import BAND_0
from tests.export.web.support import ring, small_model
from tests.tolerances import assert_close

pytest.importorskip("pxr", reason="usd-core (extra `usd`)")


@pytest.fixture
def made():
    """A model, cameras around it, and its cards."""
    model, views = small_model(sh_degree=1), list(ring().values())
    return model, views, bake_cards(model, views, steps=1)


def opened(file):
    """The stage of a file, in which no validator finds an error."""
    from pxr import Usd, UsdValidation

    stage = Usd.Stage.Open(str(file))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert validators
    assert not [error.GetMessage() for error in UsdValidation.ValidationContext(validators).Validate(stage)]
    return stage


def test_a_stage_has_the_cards_and_the_surfels(made, tmp_path):
    from pxr import Usd, UsdGeom, UsdShade

    model, views, cards = made
    file = tmp_path / "new" / "scene.usdz"
    save_usdz(file, cards, model.surfels, 1, views)
    assert [path.name for path in file.parent.iterdir()] == ["scene.usdz"]
    stage = opened(file)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetDefaultPrim().GetPath() == "/Scene"

    mesh, corners = UsdGeom.Mesh(stage.GetPrimAtPath("/Scene/Cards")), quads(cards)[0]
    assert np.array_equal(np.array(mesh.GetPointsAttr().Get()), corners.astype(np.float32))
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [4] * len(cards.rects)
    world = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))[:3, :3].T
    np.testing.assert_allclose(world, upright(views), atol=1e-12)
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeUntransformedBound(mesh.GetPrim()).GetRange()
    np.testing.assert_allclose([box.GetMin(), box.GetMax()], [corners.min(0), corners.max(0)], rtol=1e-6)
    surface, _, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].ComputeSurfaceSource()
    assert abs(surface.GetInput("opacityThreshold").Get() - cards.cut.cutoff) < 1e-6
    with zipfile.ZipFile(file) as archive:
        pictures = [archive.read(name) for name in archive.namelist() if name.endswith(".png")]
    assert np.array_equal(np.array(Image.open(io.BytesIO(pictures[0]))), to_uint8(cards.texels).numpy())

    field, surfels = stage.GetPrimAtPath("/Scene/Surfels"), model.surfels
    assert "ParticleFieldKernelGaussianSurfletAPI" in field.GetAppliedSchemas()

    def values(name: str) -> torch.Tensor:
        return torch.from_numpy(np.array(field.GetAttribute(name).Get()))

    assert values("positions").equal(surfels.means.detach())
    turned = field.GetAttribute("orientations").Get()
    quats = torch.tensor([[q.GetReal(), *q.GetImaginary()] for q in turned])
    assert_close(quats, surfels.quats, kind="value", name="orientations")
    assert_close(values("scales").log(), gaussians(surfels, 1).log_scales, kind="value", name="scales")
    assert_close(values("opacities"), surfels.opacities, kind="value", name="opacities")
    sh = values("radiance:sphericalHarmonicsCoefficients").view(len(surfels), 4, 3)
    assert sh.equal(torch.cat([surfels.sh0, surfels.shN[:, :3]], dim=1).detach())

    save_usdz(tmp_path / "dim.usdz", dataclasses.replace(cards, exposure=0.25), model.surfels, 1, views)
    dim = Usd.Stage.Open(str(tmp_path / "dim.usdz"))
    coefficients = dim.GetPrimAtPath("/Scene/Surfels").GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()
    dimmed = torch.from_numpy(np.array(coefficients)).view(len(surfels), 4, 3)
    assert dim.GetMetadata("customLayerData")["exposure"] == 0.25
    light = torch.zeros(4, 1).index_fill(0, torch.tensor(0), 0.5 / BAND_0)  # a grey of 0.5, which SH are added to
    assert_close(dimmed + light, 0.25 * (sh + light), kind="value", name="dimmed SH")
    for shown, hidden in (("surfels", "Cards"), ("cards", "Surfels")):
        stage.GetDefaultPrim().GetVariantSet("shown").SetVariantSelection(shown)
        drawn = {name: UsdGeom.Imageable(stage.GetPrimAtPath(f"/Scene/{name}")) for name in ("Cards", "Surfels")}
        visible = {name: prim.ComputeVisibility() == "inherited" for name, prim in drawn.items()}
        assert [name for name, is_visible in visible.items() if not is_visible] == [hidden]


def test_a_collision_mesh_is_there_for_physics_and_not_drawn(made, tmp_path):
    from pxr import UsdGeom

    model, views, cards = made
    points, faces = np.eye(4, 3, dtype=np.float32), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    save_usdz(tmp_path / "scene.usdz", cards, model.surfels, 1, views, Mesh(points, points, points, faces))
    stage = opened(tmp_path / "scene.usdz")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Scene/Collision"))
    assert mesh.ComputePurpose() == "guide"
    assert mesh.GetPrim().GetAppliedSchemas() == ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"]
    assert np.array_equal(np.array(mesh.GetPointsAttr().Get()), points)
    assert list(mesh.GetFaceVertexIndicesAttr().Get()) == faces.ravel().tolist()
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [3] * 4


def test_without_cards_there_is_no_file(made, tmp_path):
    model, views, _ = made
    with torch.no_grad():
        model.surfels.logit_opacities.fill_(-9.0)
    with pytest.raises(FormatError, match="expected surfels that are opaque enough"):
        save_usdz(tmp_path / "scene.usdz", bake_cards(model, views, steps=1), model.surfels, 1, views)
    assert not list(tmp_path.iterdir())
