"""A model as files that other programs open: web page, meshes, glTF, splats, PLY."""
