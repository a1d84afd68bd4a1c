import logging
import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from nodegraph.errors import DeviceError
from nodegraph.opencl import Device, list_devices, programs, source_files

FILL = '#include "value.h"\n__kernel void fill(__global float* out) { out[get_global_id(0)] = VALUE; }\n'


def fill(device, path, **options):
    out = device.empty(3)
    device.run(path, "fill", 3, out, **options)
    return float(device.to_host(out)[2])


@pytest.fixture
def device():
    """A device that has compiled nothing yet."""
    return Device(list_devices()[0])


@pytest.fixture
def source(tmp_path) -> Path:
    path = tmp_path / "fill.cl"
    path.write_text(FILL)
    (tmp_path / "value.h").write_text("#define VALUE 1.5f\n")
    return path


def age(*paths):
    """Make files old enough for their time stamps to be trusted."""
    for path in paths:
        os.utime(path, (1e9, 1e9))


def test_a_program_is_compiled_once(device, source):
    first = device.program(source)
    assert device.builds == 1
    assert fill(device, source) == 1.5
    assert device.program(str(source)) is first
    age(source, source.with_name("value.h"))
    assert device.program(source) is first
    assert device.program(source) is first
    assert device.builds == 1


def test_the_same_source_elsewhere_is_the_same_program(device, source, tmp_path):
    other = tmp_path / "elsewhere"
    other.mkdir()
    for name in ("fill.cl", "value.h"):
        (other / name).write_text((tmp_path / name).read_text())
    assert device.program(other / "fill.cl") is device.program(source)


@pytest.mark.parametrize("aged", [False, True])
def test_an_edited_header_rebuilds(device, source, aged):
    header = source.with_name("value.h")
    if aged:
        age(source, header)
    assert fill(device, source) == 1.5
    changed = header.stat().st_mtime_ns
    header.write_text("#define VALUE 2.5f\n")  # as long as before
    if not aged:  # and within the same tick of the file system's clock
        os.utime(header, ns=(changed, changed))
    assert fill(device, source) == 2.5
    assert device.builds == 2
    header.write_text("#define VALUE 1.5f\n")
    assert fill(device, source) == 1.5
    assert device.builds == 2, "the first program is still known"


def test_an_edited_header_of_a_header_rebuilds(device, source):
    header, deeper = source.with_name("value.h"), source.with_name("deeper.h")
    header.write_text('#include "deeper.h"\n#define VALUE (2 * DEEP)\n')
    deeper.write_text("#define DEEP 4.0f\n")
    assert fill(device, source) == 8
    deeper.write_text("#define DEEP 5.0f\n")
    assert fill(device, source) == 10
    assert source_files(source) == (source, header, deeper)


def test_defines_make_programs_of_their_own(device, tmp_path):
    path = tmp_path / "defined.cl"
    path.write_text("__kernel void fill(__global float* out) { out[get_global_id(0)] = VALUE; }\n")
    for value, expected in (
        (0.1, 0.1),
        (True, 1),
        (-3, -3),
        ("2 + 3", 5),
        (float("inf"), float("inf")),
        (1e-30, 1e-30),
    ):
        assert fill(device, path, defines={"VALUE": value}) == np.float32(expected)
    assert np.isnan(fill(device, path, defines={"VALUE": float("nan")}))
    assert device.builds == 7
    assert device.program(path, VALUE=0.1) is device.program(path, VALUE=0.1)
    assert device.builds == 7


@pytest.mark.parametrize(
    ("defines", "says"),
    [({"a-b": 1}, "no name for a kernel define"), ({"A": "1\n2"}, "one line"), ({"A": None}, "not NoneType")],
)
def test_defines_that_make_no_sense(device, source, defines, says):
    with pytest.raises(DeviceError, match=says):
        device.program(source, **defines)


def test_include_folders(device, source, tmp_path):
    source.with_name("value.h").unlink()
    for name, value in (("one", 1), ("two", 2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "value.h").write_text(f"#define VALUE {value}\n")
    assert fill(device, source, include=[tmp_path / "one", tmp_path / "two"]) == 1
    assert fill(device, source, include=[tmp_path / "two", tmp_path / "one"]) == 2


def test_headers_included_twice(device, tmp_path):
    (tmp_path / "once.h").write_text("#pragma once\nfloat one(void) { return 1; }\n")
    (tmp_path / "typed.h").write_text("TYPE JOIN(twice_, TYPE)(TYPE x) { return 2 * x; }\n#undef TYPE\n")
    path = tmp_path / "headers.cl"
    path.write_text(
        "#if 0\n"
        '#include "once.h"\n'
        "#endif\n"
        "/* no header of ours:\n"
        '#include "missing.h"\n'
        "*/ // /* \n"
        "#define JOIN_(a, b) a##b\n"
        "#define JOIN(a, b) JOIN_(a, b)\n"
        '#include "once.h"\n'
        "  #  include <once.h> // again\n"
        "#define TYPE int\n"
        '#include "typed.h"\n'
        "#define TYPE float\n"
        '#include "typed.h"\n'
        "__kernel void fill(__global float* out) { out[2] = one() + twice_int(2) + twice_float(0.25f); }\n"
    )
    assert fill(device, path, include=[tmp_path]) == 5.5


def test_headers_in_a_circle(device, source):
    source.with_name("value.h").write_text('#include "other.h"\n')
    source.with_name("other.h").write_text('#include "value.h"\n')
    with pytest.raises(DeviceError, match=r"in a circle \(value.h -> other.h -> value.h\)"):
        device.program(source)


def test_a_missing_header_is_told_by_the_compiler(device, source):
    source.with_name("value.h").unlink()
    with pytest.raises(DeviceError, match=r"fill\.cl line 1: 'value\.h' file not found"):
        device.program(source)


@pytest.mark.parametrize(
    ("kernel", "header", "place"),
    [
        ("__kernel void fill(__global float* out)\n{\n    out[0] = nonsense;\n}\n", "", "fill.cl line 4"),
        ("__kernel void fill(__global float* out) { f(); }\n", "\n\nfloat f(void) { return x; }\n", "value.h line 3"),
    ],
)
def test_a_compiler_error_is_one_sentence(device, source, kernel, header, place):
    source.write_text('#include "value.h"\n' + kernel)
    source.with_name("value.h").write_text(header)
    with pytest.raises(DeviceError) as caught:
        device.program(source)
    text = str(caught.value)
    assert text.startswith(f"OpenCL device '{device.info.name}' cannot compile {place}: use of undeclared identifier")
    assert "\n" not in text


def test_a_program_that_failed_may_be_mended(device, source):
    source.write_text("nonsense\n")
    with pytest.raises(DeviceError, match=r"fill.cl line 1"):
        device.program(source)
    source.write_text(FILL)
    assert fill(device, source) == 1.5


def test_a_missing_kernel_file_and_a_missing_kernel(device, tmp_path, kernels):
    with pytest.raises(DeviceError, match=r"absent.cl cannot be read: No such file"):
        device.program(tmp_path / "absent.cl")
    (tmp_path / "latin.cl").write_bytes(b"// \xe9\n")
    with pytest.raises(DeviceError, match="cannot be read as text"):
        device.program(tmp_path / "latin.cl")
    with pytest.raises(DeviceError, match=r"kernels.cl has no kernel 'scael'; did you mean 'scale'\?"):
        device.run(kernels, "scael", 1)


def test_what_the_compiler_remarks_is_logged_and_is_no_python_warning(device, source, caplog):
    source.write_text("__kernel void remark(__global float* out)\n{\n    float* p = 3;\n    out[0] = *p;\n}\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        program = device.program(source)
    assert caught == []
    assert "the OpenCL compiler remarks on fill.cl line 3: incompatible integer to pointer conversion" in caplog.text
    assert program.kernel_names == ("remark",)
    # Programs of others still warn.
    with pytest.warns(cl.CompilerWarning):
        cl.Program(device.context, "__kernel void f(__global int* p) { int* q = 4; p[0] = *q; }").build()


def test_pyopencls_disk_cache_may_fail(device, source, monkeypatch, caplog):
    # As on a driver without a cache of its own, in a home that cannot be written.
    monkeypatch.setattr("pyopencl.characterize.has_src_build_cache", lambda device: False)
    blocked = source.with_name("a file")
    blocked.write_text("")
    monkeypatch.setattr(device.context, "cache_dir", str(blocked / "cache"), raising=False)
    caplog.set_level(logging.DEBUG, "nodegraph.opencl")
    source.write_text(FILL + "// another program\n")
    assert fill(device, source) == 1.5
    assert "compiler cache failed" in caplog.text


def test_pyopencls_disk_cache_sees_edited_headers(device, source, monkeypatch):
    monkeypatch.setattr("pyopencl.characterize.has_src_build_cache", lambda device: False)
    cache = source.with_name("cache")
    monkeypatch.setattr(device.context, "cache_dir", str(cache), raising=False)
    found = []
    for value in (11, 12, 11):
        source.with_name("value.h").write_text(f"#define VALUE {value}\n")
        fresh = programs.Programs(device.context, "fresh")
        found.append(fill(device, fresh.get(source, (), {})))
    assert found == [11, 12, 11]
    assert len([item for item in cache.iterdir() if item.is_dir()]) == 2


def test_one_thread_compiles_and_the_others_wait(device, tmp_path, kernels):
    paths = []
    for index in range(3):
        path = tmp_path / f"of_threads_{index}.cl"
        path.write_text(kernels.read_text() + f"// {index}\n")
        paths.append(path)
    barrier = threading.Barrier(6)
    wrong = []

    def work(number):
        try:
            array = np.full(5000, number, np.float32)
            barrier.wait()
            for turn in range(30):
                out = device.empty(5000)
                device.run(paths[(number + turn) % 3], "scale", 5000, device.from_host(array), out, float(turn), 5000)
                if not (device.to_host(out) == number * turn).all():
                    wrong.append((number, turn))
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert device.builds == 3


def test_kernels_belong_to_their_thread(device, kernels):
    program = device.program(kernels)
    mine = program.kernel("scale")
    assert program.kernel("scale") is mine
    theirs = []
    thread = threading.Thread(target=lambda: theirs.append(program.kernel("scale")))
    thread.start()
    thread.join()
    assert theirs[0].handle != mine.handle


def test_leaving_while_kernels_run_is_clean(kernels):
    code = (
        "import sys\nfrom pathlib import Path\nfrom nodegraph.opencl import choose\ndevice = choose()\n"
        "device.run(Path(sys.argv[1]), 'slow', 1, device.empty(1), 1)\nout = device.empty(1 << 24)\n"
        "device.run(Path(sys.argv[1]), 'slow', 1 << 24, out, 2)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(kernels)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
