#!/usr/bin/env python3
"""The same voxels in goniofit and in Mitsuba 3 (volpath): equal means, and CPU seconds to equal error. See README.md beside this
file. The media agree where flakes point everywhere alike (gamma large): isotropic scattering, extinction half the density."""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import compare
from compare import HERE, LIGHT_DISTANCE, LIGHT_SIDE, ROOT, direction

ALBEDO = [0.95, 0.7, 0.3]


def arguments():
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--voxels", type=Path, required=True, help="a tile of voxels (NRRD), as volume_speed --write makes it")
    p.add_argument("--density", type=float, default=400.0, help="density of a voxel of value 1, per millimeter")
    p.add_argument("--plan", type=Path, default=HERE / "plan.toml", help="configurations (TOML)")
    p.add_argument("--configs", type=int, nargs="*", help="only these configurations of the plan")
    p.add_argument("--seconds", type=float, default=20.0, help="CPU seconds per configuration and renderer")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--goniofit", type=Path, default=ROOT / "target/release/goniofit")
    p.add_argument("--variant", default="llvm_ad_rgb")
    p.add_argument("--integrator", default="volpath", help="volpath or volpathmis")
    p.add_argument("--margin", type=float, default=2.0, help="cloth around the central tile, millimeters")
    p.add_argument("--json", action="store_true")
    return p.parse_args()


def read(path):
    """Side, bottom, densities (z, y, x)."""
    raw = path.read_bytes()
    end = raw.index(b"\n\n") + 2
    fields = dict(line.split(": ", 1) for line in raw[:end].decode().splitlines() if ": " in line)
    _, nx, ny, nz = map(int, fields["sizes"].split())
    side = float(fields["space directions"].split("(")[1].split(",")[0])
    middle = float(fields["space origin"].strip("()").split(",")[2])
    values = np.frombuffer(raw[end:], "<f4").reshape(nz, ny, nx, 4)
    return side, middle - side / 2, values[..., 0].copy()


class Mitsuba:
    def __init__(self, a):
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(a.variant)
        dr.set_thread_count(1)
        self.mi, self.a = mi, a
        side, bottom, density = read(a.voxels)
        nz, ny, nx = density.shape
        self.size = np.array([nx, ny]) * side
        copies = [max(1, math.ceil(a.margin / s)) for s in self.size]
        data = np.tile(density, (1, 2 * copies[1] + 1, 2 * copies[0] + 1))[..., None]
        whole = np.array([data.shape[2], data.shape[1], nz]) * side
        low = np.array([-copies[0] * self.size[0], -copies[1] * self.size[1], bottom])
        t = mi.ScalarTransform4f
        place = t().translate(list(low)).scale(list(whole))
        medium = {
            "type": "heterogeneous",
            "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(data.astype(np.float32)), "filter_type": "nearest",
                        "raw": True, "to_world": place},
            "albedo": {"type": "constvolume", "value": {"type": "rgb", "value": ALBEDO}},
            "phase": {"type": "isotropic"},
            "scale": 0.5 * a.density,
        }
        box = t().translate(list(low + whole / 2)).scale(list(whole / 2))
        self.cloth = {"type": "cube", "to_world": box, "bsdf": {"type": "null"}, "interior": medium}

    def scene(self, light, camera):
        t = self.mi.ScalarTransform4f
        theta, phi = map(math.radians, light)
        up = [-math.cos(theta) * math.cos(phi), -math.cos(theta) * math.sin(phi), math.sin(theta)]
        lamp = t().look_at(origin=list(direction(*light) * LIGHT_DISTANCE), target=[0, 0, 0], up=up)
        view = np.eye(4)
        view[:3, 0], view[:3, 1] = [self.size[0] / 2, 0, 0], [0, self.size[1] / 2, 0]
        view[:3, 2], view[:3, 3] = -camera, camera * 20.0
        film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb",
                "component_format": "float32", "sample_border": False}
        return self.mi.load_dict({
            "type": "scene",
            "integrator": {"type": self.a.integrator, "max_depth": -1, "rr_depth": 5},
            "sensor": {"type": "orthographic", "far_clip": 1000.0, "to_world": t(view), "film": film,
                       "sampler": {"type": "independent", "sample_count": 16}},
            "lamp": {"type": "rectangle", "to_world": lamp.scale(0.5 * LIGHT_SIDE),
                     "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}},
            "cloth": self.cloth,
        })

    means = compare.Mitsuba.means


def fabric(a, folder):
    """A description of the voxels, and the parameters of an isotropic medium."""
    where = folder / "volume.toml"
    where.write_text(f'kind = "voxels"\nname = "volume"\nfile = "{a.voxels.resolve()}"\ndensity_per_mm = {a.density}\n')
    parameters = folder / "isotropic.json"
    parameters.write_text(json.dumps({"albedo": ALBEDO, "gamma": 100.0}))
    return where, parameters


def goniofit_means(a, inputs, plan, effort):
    where, parameters = inputs
    command = [a.goniofit, "render", "means", "--model", "microflake", "--fabric", where, "--params", parameters]
    command += ["--plan", plan, "--json", "--seed", str(a.seed)] + effort
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ, RAYON_NUM_THREADS="1"))
    if done.returncode != 0:
        sys.exit(done.stderr)
    return json.loads(done.stdout)


def main():
    a = arguments()
    mitsuba, rows = Mitsuba(a), []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        inputs = fabric(a, folder)
        for c, light, camera in compare.poses(a.plan, a.configs):
            plan = folder / "one.toml"
            plan.write_text(compare.one_pose(c))
            first = goniofit_means(a, inputs, plan, ["--paths", "20000"])
            paths = max(20_000, int(20_000 * a.seconds / first["cpu_s"]))
            ours = goniofit_means(a, inputs, plan, ["--paths", str(paths)])
            e = ours["configs"][0]
            pair = [compare.record("goniofit", c["config"], e["mean"], e["se"], ours["cpu_s"], e["paths"])]
            pair.append(compare.record("mitsuba", c["config"], *mitsuba.means(light, camera, a.seconds)))
            rows.append(pair)
            compare.report(a, pair)
    for k, renderer in enumerate(["goniofit", "mitsuba"]):
        needed = [pair[k]["cpu_s_for_1pct"] for pair in rows]
        best = sum(map(math.sqrt, needed)) ** 2 / len(needed)
        print(json.dumps({"renderer": renderer, "config": "total", "cpu_s_for_1pct": best}))


if __name__ == "__main__":
    main()
