"""Renders rays with Mitsuba 3, in a process of its own: its compiler may end the process.

    python mitsuba_reference.py INPUT.npz OUTPUT.npy

Exits with 77 where Mitsuba cannot run. Shares nothing with univoxel but the fitted E, as a table.
"""

import math
import sys
import time

import numpy as np

try:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    import drjit as dr

    dr.eval(mi.Float(0) + 1)
except Exception as error:  # no mitsuba, no such variant, or no LLVM for drjit
    print(error, file=sys.stderr)
    sys.exit(77)

PASSES = 8  # bounds memory


class Layered(mi.BSDF):
    """docs/reference/conventions.md as a BSDF, sampled by the cosine; written in drjit."""

    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.albedo, self.roughness = mi.Color3f(props["albedo"]), float(props["roughness"])
        self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]
        self.layer = mi.Float(np.array(props["layer"]).ravel())  # E, tabulated over the cosine

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs = mi.BSDFSample3f()
        bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
        bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
        bs.eta, bs.sampled_type = 1.0, mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        bs.sampled_component = mi.UInt32(0)
        active &= (bs.pdf > 0) & (mi.Frame3f.cos_theta(si.wi) > 0)
        return bs, self.eval(ctx, si, bs.wo, active) / bs.pdf & active

    def eval(self, ctx, si, wo, active=True):
        v, light = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        a2 = self.roughness**4
        h = dr.normalize(si.wi + wo)
        d = a2 / (math.pi * ((h.z**2) * (a2 - 1) + 1) ** 2)
        root = dr.sqrt(light**2 * (1 - a2) + a2), dr.sqrt(v**2 * (1 - a2) + a2)
        vis = 0.5 / dr.maximum(v * root[0] + light * root[1], 1e-6)
        f = 0.04 + 0.96 * (1 - dr.dot(si.wi, h)) ** 5
        at = mi.UInt32(dr.clip(v, 0, 1) * 1024)
        layer = dr.gather(mi.Float, self.layer, at)
        value = self.albedo * (1 - layer) / math.pi + d * f * vis
        return value * light & (active & (v > 0) & (light > 0))

    def pdf(self, ctx, si, wo, active=True):
        up = (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        return mi.warp.square_to_cosine_hemisphere_pdf(wo) & (active & up)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)


mi.register_bsdf("layered", Layered)


def load_mesh(name, vertices, faces, normals, albedo, roughness, layer):
    props = mi.Properties()
    color = mi.ScalarColor3f(albedo.tolist())
    if layer is None:
        bsdf = {"type": "principled", "base_color": {"type": "rgb", "value": color}}
        props["bsdf"] = mi.load_dict(bsdf | {"roughness": float(roughness), "specular": 0.5})
    else:
        bsdf = {"type": "layered", "albedo": color, "layer": mi.TensorXf(layer)}
        props["bsdf"] = mi.load_dict(bsdf | {"roughness": float(roughness)})
    mesh = mi.Mesh(name, len(vertices), len(faces), props=props, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params["vertex_normals"] = normals.ravel()
    params.update()
    return mesh


def render(
    vertices,
    faces,
    normals,
    part,
    albedo,
    roughness,
    layer,
    radiance,
    origin,
    direction,
    bounces,
    samples,
    principled=False,
):
    """Radiance [N, 3] along rays. Vertices of part 0 come first, then those of part 1, if any.

    With `principled` the materials are Mitsuba's own instead of ours.
    """
    scene = {
        "type": "scene",
        "light": {
            "type": "envmap",
            "bitmap": mi.Bitmap(radiance),
            "to_world": mi.ScalarTransform4f(
                [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
            ),
        },
    }
    for k, name in enumerate(("first", "second")[: len(albedo)]):
        own = faces[part[faces[:, 0]] == k] - np.argmax(part == k)
        look = albedo[k], roughness[k], None if principled else layer[k]
        scene[name] = load_mesh(name, vertices[part == k], own, normals[part == k], *look)
    scene = mi.load_dict(scene)
    integrator = mi.load_dict({"type": "path", "max_depth": int(bounces) + 2, "rr_depth": 100})
    each = int(samples) // PASSES
    count, total = len(origin) * each, 0
    index = dr.arange(mi.UInt32, count) // each
    o, d = (
        mi.Vector3f(*(dr.gather(mi.Float, mi.Float(np.ascontiguousarray(x)), index) for x in a.T))
        for a in (origin, direction)
    )
    for seed in range(-1, PASSES):  # the first one compiles, and is dropped
        if seed == 0:
            total, start = 0, time.perf_counter()
        sampler = mi.load_dict({"type": "independent", "sample_count": 1})
        sampler.seed(seed + 1, count)
        color, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(o, d))
        total = total + np.stack([dr.block_sum(c, each).numpy() for c in color], 1)
    print(f"seconds {time.perf_counter() - start}", file=sys.stderr)
    return total / (each * PASSES)


if __name__ == "__main__":
    np.save(sys.argv[2], render(**np.load(sys.argv[1])))
