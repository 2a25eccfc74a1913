import os
import socket
import subprocess
import sys
import textwrap

import torch

SCRIPT = """
import sys, torch
import torch.distributed as distributed
from torchkcreg.geometry import MultisourceScanner, VolumeGrid
from torchkcreg.reconstruction import PWLS, PWLSConfig, ViewShard, VoxelSystem, fdk, statistical_weights

torch.set_num_threads(1)
if sys.argv[2] == "2":
    distributed.init_process_group("gloo")
geometry = MultisourceScanner(det_shape=(24, 20), det_size_mm=(298, 248), num_views=200).geometry()
grid = VolumeGrid.centered((10, 10, 10), 8.0)
data = torch.rand(200, 24, 20, generator=torch.Generator().manual_seed(0))
shard = ViewShard.of(200) if distributed.is_initialized() else None
config = PWLSConfig(iterations=3, subsets=20, objective_every=1)
solver = PWLS(VoxelSystem(geometry, grid), data, statistical_weights(torch.exp(-data)), config, shard=shard)
volume = solver.run().volume
result = {"fdk": fdk(data, geometry, grid, shard=shard), "pwls": volume, "objective": solver.history[-1]["objective"]}
if not distributed.is_initialized() or distributed.get_rank() == 0:
    torch.save(result, sys.argv[1])
if distributed.is_initialized():
    distributed.destroy_process_group()
"""


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return str(listener.getsockname()[1])


def run(folder, processes):
    script, out = folder / "shards.py", folder / f"{processes}.pt"
    script.write_text(textwrap.dedent(SCRIPT))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    start = [sys.executable]
    if processes > 1:
        start += ["-m", "torch.distributed.run", "--nproc-per-node", str(processes), "--master-port", free_port()]
    subprocess.run([*start, str(script), str(out), str(processes)], check=True, env=environment, capture_output=True)
    return torch.load(out, weights_only=True)


def test_two_processes_make_the_volume_of_one(tmp_path):
    one, two = run(tmp_path, 1), run(tmp_path, 2)
    for name in ("fdk", "pwls"):
        assert (one[name] - two[name]).abs().max() <= 1e-5 * one[name].abs().max()
    assert abs(one["objective"] / two["objective"] - 1) < 1e-5
