from pathlib import Path

import pytest

from nodegraph.opencl import Device, list_devices

KERNELS = """
__kernel void scale(__global const float* restrict a, __global float* restrict out, const float factor, const uint n)
{
    const size_t i = get_global_id(0);
    if (i < n) out[i] = factor * a[i];
}

__kernel void transpose(__global const float* restrict a, __global float* restrict out)
{
    const size_t col = get_global_id(0), row = get_global_id(1);
    out[col * get_global_size(1) + row] = a[row * get_global_size(0) + col];
}

__kernel void tilt(__global float* out, const float3 normal, __local float* scratch, __global const float* mask)
{
    scratch[get_local_id(0)] = normal.x + 10 * normal.y + 100 * normal.z;
    out[get_global_id(0)] = scratch[get_local_id(0)] * (mask ? mask[0] : 1);
}

__kernel void slow(__global float* out, const uint n)
{
    float x = get_global_id(0);
    for (uint i = 0; i < n; i++) x = sin(x + i);
    out[get_global_id(0)] = x;
}

__kernel void count(__global const uchar* flags, __global const float2* waves, __global int* out, const char step)
{
    out[get_global_id(0)] = flags[get_global_id(0)] * step + (int) waves[get_global_id(0)].y;
}
"""


def _open(**options):
    info = next(info for info in list_devices() if info.kind == "cpu")
    return Device(info, **options)


@pytest.fixture(scope="session")
def shared():
    return _open()


@pytest.fixture(scope="session")
def copying():
    return _open(unified=False)


@pytest.fixture(scope="session", params=["shared", "copying"])
def device(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def kernels(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("with a space") / "kernels.cl"
    path.write_text(KERNELS)
    return path
