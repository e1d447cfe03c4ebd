"""Our structures and request numbers against the kernel's own headers, through the C compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest
from vical_drivers.camera.iidc import abi as iidc_abi
from vical_drivers.camera.v4l2 import abi
from vical_mocks import firewire_rig

HEADER = Path("/usr/include/linux/videodev2.h")

REQUESTS = [name for name in vars(abi) if name.startswith("VIDIOC_")]
CONSTANTS = {
    "V4L2_CID_EXPOSURE_ABSOLUTE": abi.CID_EXPOSURE_ABSOLUTE,
    "V4L2_CID_EXPOSURE_AUTO": abi.CID_EXPOSURE_AUTO,
    "V4L2_CID_EXPOSURE_AUTO_PRIORITY": abi.CID_EXPOSURE_AUTO_PRIORITY,
    "V4L2_CID_GAIN": abi.CID_GAIN,
    "V4L2_CID_AUTOGAIN": abi.CID_AUTOGAIN,
    "V4L2_CID_ANALOGUE_GAIN": abi.CID_ANALOGUE_GAIN,
    "V4L2_CID_FOCUS_AUTO": abi.CID_FOCUS_AUTO,
    "V4L2_CID_IMAGE_STABILIZATION": abi.CID_IMAGE_STABILIZATION,
    "V4L2_CID_AUTO_WHITE_BALANCE": abi.CID_AUTO_WHITE_BALANCE,
    "V4L2_BUF_FLAG_TSTAMP_SRC_SOE": abi.BUF_FLAG_TSTAMP_SRC_SOE,
    "V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC": abi.BUF_FLAG_TIMESTAMP_MONOTONIC,
    "V4L2_BUF_FLAG_ERROR": abi.BUF_FLAG_ERROR,
    "V4L2_CAP_META_CAPTURE": abi.CAP_META_CAPTURE,
    "V4L2_CAP_STREAMING": abi.CAP_STREAMING,
    "V4L2_BUF_TYPE_META_CAPTURE": abi.BUF_TYPE_META_CAPTURE,
    "V4L2_CTRL_FLAG_NEXT_CTRL": abi.CTRL_FLAG_NEXT_CTRL,
    "V4L2_EXPOSURE_MANUAL": abi.EXPOSURE_MANUAL,
    "V4L2_EVENT_CTRL": abi.EVENT_CTRL,
}
OFFSETS = {
    "struct v4l2_buffer, timestamp": abi.Buffer.tv_sec.offset,
    "struct v4l2_buffer, sequence": abi.Buffer.sequence.offset,
    "struct v4l2_buffer, m": abi.Buffer.m.offset,
    "struct v4l2_buffer, length": abi.Buffer.length.offset,
    "struct v4l2_format, fmt": abi.Format.fmt.offset,
    "struct v4l2_query_ext_ctrl, default_value": abi.QueryExtCtrl.default_value.offset,
    "struct v4l2_ext_controls, controls": abi.ExtControls.controls.offset,
    "struct v4l2_event, id": abi.Event.id.offset,
    "struct v4l2_streamparm, parm": abi.StreamParm.parm.offset,
}


@pytest.fixture(scope="module")
def c_values(tmp_path_factory) -> dict[str, int]:
    """What a C program compiled with the kernel's headers says."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: apt install gcc")
    if not HEADER.exists():
        pytest.skip(f"no {HEADER}: apt install linux-libc-dev")
    expressions = {name: name for name in [*REQUESTS, *CONSTANTS]}
    expressions |= {name: f"sizeof(struct {name})" for name in abi.SIZES}
    expressions |= {place: f"offsetof({place})" for place in OFFSETS}
    prints = "\n".join(
        f'printf("{label}=%lu\\n", (unsigned long)({expression}) & 0xffffffffUL);'
        for label, expression in expressions.items()
    )
    folder = tmp_path_factory.mktemp("abi")
    source = folder / "abi.c"
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\n"
        f"int main(void) {{\n{prints}\nreturn 0;\n}}\n"
    )
    subprocess.run([compiler, "-o", folder / "abi", source], check=True, capture_output=True)
    output = subprocess.run([folder / "abi"], check=True, capture_output=True, text=True).stdout
    return {label: int(value) for label, value in (line.rsplit("=", 1) for line in output.splitlines())}


def test_request_numbers(c_values: dict[str, int]) -> None:
    assert len(REQUESTS) >= 20
    assert {name: getattr(abi, name) for name in REQUESTS} == {n: c_values[n] for n in REQUESTS}


def test_constants(c_values: dict[str, int]) -> None:
    assert {name: c_values[name] for name in CONSTANTS} == CONSTANTS


def test_sizes_and_offsets(c_values: dict[str, int]) -> None:
    assert {name: c_values[name] for name in abi.SIZES} == {n: size for n, (_, size) in abi.SIZES.items()}
    assert {place: c_values[place] for place in OFFSETS} == OFFSETS


@pytest.mark.parametrize("module", [abi, iidc_abi, firewire_rig])
def test_packed_structures_name_their_layout(module) -> None:
    """From Python 3.14 on `_pack_` alone is deprecated, from 3.19 on an error."""
    kinds = (ctypes.Structure, ctypes.Union)
    found = [c for c in vars(module).values() if isinstance(c, type) and issubclass(c, kinds)]
    assert found
    assert [c.__name__ for c in found if "_pack_" in vars(c) and "_layout_" not in vars(c)] == []
