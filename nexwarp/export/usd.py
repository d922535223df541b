"""The baked scene and the surfels as a USDZ file, for programs of film and of simulation."""

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from nexwarp.cameras.camera import Camera
from nexwarp.cameras.similarity import upright
from nexwarp.errors import FormatError
from nexwarp.export.baked_scene import BakedScene
from nexwarp.export.glb import quads
from nexwarp.export.mesh import Mesh
from nexwarp.export.splats import gaussians
from nexwarp.io.files import write_atomically
from nexwarp.io.pictures import encoded, to_uint8
from nexwarp.kernels.sh import BAND_0
from nexwarp.model.surfels import Surfels

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

ROOT, VARIANTS = "/Scene", "shown"


@torch.no_grad()
def save_usdz(
    path: str | os.PathLike[str],
    scene: BakedScene,
    surfels: Surfels,
    sh_degree: int,
    cameras: Sequence[Camera],
    collision: Mesh | None = None,
) -> None:
    """Write cards and surfels as one USDZ file, atomically; the default prim's variant `shown` chooses between them.

    `Cards`, which is shown at first, is a mesh of quads with one unlit UsdPreviewSurface. `Surfels` is a particle field
    with the kernel of Gaussian surflets: the plain appearance, with the surfels' integrals, and SH up to `sh_degree`.
    `Collision`, if given, is a mesh that is not shown, for physics. The mean of the cameras' upward directions becomes
    +y, by the default prim. FormatError: there are no cards.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils

    if not len(scene.shape.means):
        raise FormatError(f"{path}: expected surfels that are opaque enough to be seen, found none")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "atlas.png").write_bytes(encoded(to_uint8(scene.texels).cpu().numpy(), format="PNG"))
        stage = Usd.Stage.CreateNew(str(Path(folder, "scene.usdc")))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, ROOT)
        stage.SetDefaultPrim(root.GetPrim())
        stage.SetMetadata("customLayerData", {"exposure": scene.exposure})
        turn = np.eye(4)
        turn[:3, :3] = upright(cameras)
        root.AddTransformOp().Set(Gf.Matrix4d(turn.T.tolist()))  # of row vectors
        forms = {"cards": _cards(stage, scene), "surfels": _particles(stage, surfels, sh_degree, scene.exposure)}
        if collision is not None:
            _collider(stage, collision)
        choice = root.GetPrim().GetVariantSets().AddVariantSet(VARIANTS)
        for name in forms:
            choice.AddVariant(name)
            choice.SetVariantSelection(name)
            with choice.GetVariantEditContext():
                for other, form in forms.items():
                    shown = UsdGeom.Tokens.inherited if other == name else UsdGeom.Tokens.invisible
                    form.CreateVisibilityAttr(shown)
        choice.SetVariantSelection("cards")
        stage.GetRootLayer().Save()
        packed = Path(folder, "scene.usdz")
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(Path(folder, "scene.usdc"))), str(packed)):
            raise OSError(f"{path}: usd-core could not pack it")
        write_atomically(Path(path), packed.read_bytes())


def _cards(stage: "Usd.Stage", scene: BakedScene) -> "UsdGeom.Gprim":
    """Define the mesh of the cards and its material."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    corners, places, _ = quads(scene)
    mesh = _mesh(stage, "Cards", corners, np.arange(len(corners)).reshape(-1, 4))
    interface = UsdGeom.PrimvarsAPI(mesh)
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    st = interface.CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
    st.Set(Vt.Vec2fArray.FromNumpy(places.astype(np.float32)))

    material = UsdShade.Material.Define(stage, f"{ROOT}/Material")
    shaders = {}
    kinds = {"Surface": "UsdPreviewSurface", "Atlas": "UsdUVTexture", "St": "UsdPrimvarReader_float2"}
    for name, identifier in kinds.items():
        shaders[name] = UsdShade.Shader.Define(stage, f"{ROOT}/Material/{name}")
        shaders[name].CreateIdAttr(identifier)
    surface, atlas, reader = shaders.values()
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    atlas.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("atlas.png")
    atlas.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        atlas.CreateInput(side, Sdf.ValueTypeNames.Token).Set("clamp")
    places_input = atlas.CreateInput("st", Sdf.ValueTypeNames.Float2)
    places_input.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
    # The colours have their light already: they are emitted, and nothing is reflected.
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
    surface.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
    surface.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
    emitted = surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f)
    emitted.ConnectToSource(atlas.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    opacity = surface.CreateInput("opacity", Sdf.ValueTypeNames.Float)
    opacity.ConnectToSource(atlas.CreateOutput("a", Sdf.ValueTypeNames.Float))
    if scene.cut is not None:
        surface.CreateInput("opacityThreshold", Sdf.ValueTypeNames.Float).Set(scene.cut.cutoff)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return mesh


def _collider(stage: "Usd.Stage", collision: Mesh) -> None:
    """Define the mesh that things bump into: a guide, which programs do not draw."""
    from pxr import UsdGeom, UsdPhysics

    mesh = _mesh(stage, "Collision", collision.vertices, collision.triangles)
    mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)


def _mesh(stage: "Usd.Stage", name: str, points: np.ndarray, faces: np.ndarray) -> "UsdGeom.Mesh":
    """Define a mesh of points (V, 3) and faces (F, corners) of their indices."""
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/{name}")
    vertices = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
    mesh.CreatePointsAttr(vertices)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(vertices))
    return mesh


def _particles(stage: "Usd.Stage", surfels: Surfels, sh_degree: int, exposure: float) -> "UsdGeom.Gprim":
    """Define the particle field of the surfels, dimmed as the cards are."""
    from pxr import UsdGeom, UsdVol, Vt

    splats = gaussians(surfels, sh_degree, (), float("inf"))  # surflets are exact at any size
    shape = (splats.means, splats.quats.roll(-1, 1), splats.log_scales.exp(), splats.logit_opacities.sigmoid())
    means, quats, scales, opacities, sh = (x.float().cpu().numpy() for x in (*shape, splats.sh))
    sh = sh * exposure
    sh[:, 0] += (exposure - 1) * 0.5 / BAND_0
    field = UsdVol.ParticleField.Define(stage, f"{ROOT}/Surfels")
    prim = field.GetPrim()
    UsdVol.ParticleFieldKernelGaussianSurfletAPI.Apply(prim)
    positions = UsdVol.ParticleFieldPositionAttributeAPI.Apply(prim)
    positions.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
    orientations = UsdVol.ParticleFieldOrientationAttributeAPI.Apply(prim)
    orientations.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats))
    UsdVol.ParticleFieldScaleAttributeAPI.Apply(prim).CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    UsdVol.ParticleFieldOpacityAttributeAPI.Apply(prim).CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities))
    radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI.Apply(prim)
    radiance.CreateRadianceSphericalHarmonicsDegreeAttr(sh_degree)
    coefficients = np.ascontiguousarray(sh.reshape(-1, 3))
    radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
    reach = 3 * scales.max(axis=1, keepdims=True)  # where the support ends
    ends = Vt.Vec3fArray.FromNumpy(np.concatenate([means - reach, means + reach]))
    field.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(ends))
    return field
