"""A tiny stereo scene of a rover's cameras, written as PDS3, PDS4 and VICAR products."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.geometry.cahv import CahvModel, make_cahv_model

SIZE_PX = (320, 240)
DOWN_TO_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""R_rover_camera of a camera that looks along the rover's x (forward, right, down)."""

BOX = np.array([[3.2, -0.6, -0.5], [3.8, 0.0, 0.0]])
"""Corners of a box on the ground z = 0 of the rover frame (z down)."""

E_TERMS = (0.004, 0.006, 0.002)


def eye(
    side_m: float,
    turn: tuple[float, float, float] = (-0.42, 0.0, 0.0),
    kind: str = "CAHVOR",
    focal_px: float = 240.0,
    E: tuple[float, float, float] = E_TERMS,
) -> CahvModel:
    """A camera 1.2 m above the ground, looking ahead and down by 0.42 rad."""
    x, y, z = (DOWN_TO_CAMERA @ Rotation.from_rotvec(turn).as_matrix()).T
    H, V = focal_px * x + 161.3 * z, focal_px * y + 117.2 * z
    parts = [np.array([0.5, side_m, -1.2]), z, H, V, z, np.array([0, 0.08, 0.01]), np.array(E)]
    return make_cahv_model(parts[: {"CAHV": 4, "CAHVOR": 6, "CAHVORE": 7}[kind]], 2 if kind == "CAHVORE" else 1)


def rig(kind: str = "CAHVOR", pan: float = 0.0) -> tuple[CahvModel, CahvModel]:
    """Two eyes 0.3 m apart, a little toed in and rolled, panned together about a mast at (0.5, 0)."""
    left = eye(-0.15, (-0.42, 0.012, 0.004), kind)
    right = eye(0.15, (-0.41, -0.015, -0.006), kind, 241.5)
    mast = np.eye(4)
    mast[:3, :3] = Rotation.from_rotvec([0, 0, pan]).as_matrix()
    mast[:3, 3] = [0.5, 0, 0] - mast[:3, :3] @ [0.5, 0, 0]
    return left.moved(mast), right.moved(mast)


def hits(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where rays of the rover frame meet the ground or the box: NaN for the sky."""
    with np.errstate(all="ignore"):
        to_ground = -origins[..., 2] / directions[..., 2]
        to_ground[~(to_ground > 0)] = np.inf
        to_planes = (BOX[:, None] - origins.reshape(-1, 3)) / directions.reshape(-1, 3)
        enter, leave = to_planes.min(0).max(-1), to_planes.max(0).min(-1)
        to_box = np.where((enter < leave) & (enter > 0), enter, np.inf).reshape(to_ground.shape)
        distance = np.minimum(to_ground, to_box)
        return np.where(np.isfinite(distance)[..., None], origins + distance[..., None] * directions, np.nan)


def brightness(points: np.ndarray) -> np.ndarray:
    """A fixed texture of the scene, 0 to 1, fine near the cameras and coarse far away."""
    noise = np.random.default_rng(7).random((256, 256)).astype(np.float32)
    total = np.zeros(points.shape[:-1], np.float32)
    shifted = np.nan_to_num(points[..., :2] + 0.73 * points[..., 2:])
    for scale, weight in ((8, 0.3), (20, 0.4), (50, 0.3)):
        # A multiple of the period keeps negative coordinates inside.
        x, y = ((scale * shifted[..., axis] + 25600) % 255 for axis in (0, 1))
        total += weight * cv2.remap(noise, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)
    return np.where(np.isnan(points[..., 0]), 0.9, np.clip(total, 0, 1))


def render(model: CahvModel, top: int, dtype: str) -> np.ndarray:
    """What a camera sees, from 0 to `top`."""
    grid = np.stack(np.meshgrid(np.arange(SIZE_PX[0]), np.arange(SIZE_PX[1])), -1)
    return (top * brightness(hits(*model.rays(grid.astype(float))))).astype(dtype)


def components(model: CahvModel, kind: str) -> list[list[float]]:
    return [list(getattr(model, letter)) for letter in kind]


def keywords(
    model: CahvModel,
    kind: str,
    side: str,
    clock_s: float,
    offset: tuple[float, float, float] = (12.0, -5.0, 0.3),
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    site: int = 3,
) -> dict[str, dict]:
    """The groups of a label: what a mission writes, cut short."""
    lens = {"MODEL_COMPONENT_8": 2.0, "MODEL_COMPONENT_9": 0.0} if kind == "CAHVORE" else {}
    minutes, seconds = divmod(clock_s - 127168000, 60)
    return {
        "": {
            "INSTRUMENT_HOST_ID": "TEST",
            "INSTRUMENT_ID": f"NAVCAM_{side.upper()}",
            "SPACECRAFT_CLOCK_START_COUNT": f"{clock_s:.3f}",
            "START_TIME": f"2004-01-12T08:{int(minutes):02d}:{seconds:06.3f}",
        },
        "GEOMETRIC_CAMERA_MODEL": {
            "MODEL_TYPE": kind,
            **{f"MODEL_COMPONENT_{i}": part for i, part in enumerate(components(model, kind), 1)},
            **lens,
            "REFERENCE_COORD_SYSTEM_NAME": "ROVER_FRAME",
        },
        "ROVER_COORDINATE_SYSTEM": {
            "COORDINATE_SYSTEM_NAME": "ROVER_FRAME",
            "COORDINATE_SYSTEM_INDEX": [site, 11, 0],
            "ORIGIN_OFFSET_VECTOR": list(offset),
            "ORIGIN_ROTATION_QUATERNION": list(quaternion),
            "REFERENCE_COORD_SYSTEM_NAME": "SITE_FRAME",
        },
    }


def _odl(value) -> str:
    if isinstance(value, list):
        return f"({', '.join(map(_odl, value))})"
    return f'"{value}"' if isinstance(value, str) and not value.startswith("2#") and value != "END" else f"{value}"


def write_pds3(path: Path, pixels: np.ndarray, groups: dict[str, dict], image: dict | None = None) -> None:
    """`NAME.IMG` with its label, or, for `NAME.LBL`, the label and `NAME.IMG`."""
    attached = path.suffix == ".IMG"
    lines, samples = pixels.shape
    stored = pixels.astype(">i2" if pixels.dtype.itemsize == 2 else np.uint8)
    record = samples * stored.itemsize
    label_records = 0
    for _ in range(2):
        pointer = label_records + 1 if attached else path.with_suffix(".IMG").name
        rows = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {record}",
                f"FILE_RECORDS = {lines + label_records}", f"^IMAGE = {_odl(pointer)}"]  # fmt: skip
        for name, group in groups.items():
            rows += [f"GROUP = {name}"] * bool(name)
            rows += [f"{key} = {_odl(value)}" for key, value in group.items()]
            rows += [f"END_GROUP = {name}"] * bool(name)
        kind = "MSB_INTEGER" if stored.itemsize == 2 else "UNSIGNED_INTEGER"
        described = {"LINES": lines, "LINE_SAMPLES": samples, "SAMPLE_BITS": 8 * stored.itemsize, **(image or {})}
        rows += ["OBJECT = IMAGE", f"SAMPLE_TYPE = {kind}", *(f"{key} = {_odl(v)}" for key, v in described.items())]
        text = "\r\n".join([*rows, "END_OBJECT = IMAGE", "END", ""]).encode()
        label_records = -(-len(text) // record) if attached else 0
    if attached:
        path.write_bytes(text.ljust(label_records * record) + stored.tobytes())
    else:
        path.write_bytes(text)
        path.with_suffix(".IMG").write_bytes(stored.tobytes())


def write_vicar(path: Path, pixels: np.ndarray, groups: dict[str, dict], image: dict | None = None) -> None:
    lines, samples = pixels.shape
    stored = pixels.astype("<i2" if pixels.dtype.itemsize == 2 else np.uint8)
    record = samples * stored.itemsize
    text = (f"FORMAT='{'HALF' if stored.itemsize == 2 else 'BYTE'}'  TYPE='IMAGE'  BUFSIZ={record}  DIM=3  EOL=0  "
            f"RECSIZE={record}  ORG='BSQ'  NL={lines}  NS={samples}  NB=1  N1={samples}  N2={lines}  N3=1  N4=0  "
            "NBB=0  NLB=0  HOST='X86-LINUX'  INTFMT='LOW'  REALFMT='RIEEE'  BHOST='X86-LINUX'  BINTFMT='LOW'  "
            "BREALFMT='RIEEE'  BLTYPE=''  ")  # fmt: skip
    for name, group in {**groups, "IMAGE_DATA": image or {}}.items():
        text += f"PROPERTY='{name or 'IDENTIFICATION'}'  "
        text += "".join(f"{key}={_odl(value)}  ".replace('"', "'") for key, value in group.items())
    text += "TASK='TASK'  USER='test'  DAT_TIM='Mon Jan 12 08:00:00 2004'  "
    size = -(-(len(text) + 20) // record) * record
    path.write_bytes(f"LBLSIZE={size}  {text}".encode().ljust(size, b"\0") + stored.tobytes())


def write_pds4(path: Path, pixels: np.ndarray, groups: dict[str, dict], image: dict | None = None) -> None:
    """`NAME.xml` and `NAME.img`."""
    lines, samples = pixels.shape
    stored = pixels.astype("<u2" if pixels.dtype.itemsize == 2 else np.uint8)
    own, model, rover = groups[""], groups["GEOMETRIC_CAMERA_MODEL"], groups["ROVER_COORDINATE_SYSTEM"]
    kind, site = model["MODEL_TYPE"], rover["COORDINATE_SYSTEM_INDEX"][0]

    def vector(name: str, values: list[float], fields: str) -> str:
        inner = "".join(f"<geom:{f}>{v!r}</geom:{f}>" for f, v in zip(fields.split(), map(float, values), strict=True))
        return f"<geom:{name}>{inner}</geom:{name}>"

    forms = (
        ("Vector_Center", "x_position y_position z_position"), ("Vector_Axis", "x_unit y_unit z_unit"),
        ("Vector_Horizontal", "x_pixel y_pixel z_pixel"), ("Vector_Vertical", "x_pixel y_pixel z_pixel"),
        ("Vector_Optical", "x_unit y_unit z_unit"), ("Radial_Terms", "c0 c1 c2"), ("Entrance_Terms", "c0 c1 c2"),
    )  # fmt: skip
    vectors = "".join(
        vector(name, model[f"MODEL_COMPONENT_{i}"], fields) for i, (name, fields) in enumerate(forms[: len(kind)], 1)
    )
    if kind == "CAHVORE":
        vectors += "<geom:cahvore_model_type>2</geom:cahvore_model_type>"
        vectors += "<geom:cahvore_model_parameter>0.0</geom:cahvore_model_parameter>"
    quaternion = vector("Quaternion_Plus_Direction", rover["ORIGIN_ROTATION_QUATERNION"], "qcos qsin1 qsin2 qsin3")
    part = image or {}
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" xmlns:geom="http://pds.nasa.gov/pds4/geom/v1"
 xmlns:img="http://pds.nasa.gov/pds4/img/v1" xmlns:msn="http://pds.nasa.gov/pds4/msn/v1">
<Identification_Area><logical_identifier>urn:nasa:pds:test:data:{path.stem.lower()}</logical_identifier>
</Identification_Area>
<Observation_Area><Time_Coordinates><start_date_time>{own["START_TIME"]}Z</start_date_time></Time_Coordinates>
<Investigation_Area><name>Test</name></Investigation_Area>
<Observing_System><Observing_System_Component><name>Rover</name><type>Host</type></Observing_System_Component>
<Observing_System_Component><name>{own["INSTRUMENT_ID"].replace("_", " ").title()}</name><type>Instrument</type>
</Observing_System_Component></Observing_System>
<Discipline_Area><msn:Surface_Mission>
<msn:spacecraft_clock_start>{own["SPACECRAFT_CLOCK_START_COUNT"]}</msn:spacecraft_clock_start></msn:Surface_Mission>
<img:Imaging><img:Subframe><img:first_line>{part.get("FIRST_LINE", 1)}</img:first_line>
<img:first_sample>{part.get("FIRST_LINE_SAMPLE", 1)}</img:first_sample></img:Subframe></img:Imaging>
<geom:Geometry><geom:Geometry_Lander><geom:Camera_Model_Parameters><geom:model_type>{kind}</geom:model_type>
<geom:{kind}_Model>{vectors}</geom:{kind}_Model>
<geom:Coordinate_Space_Reference><geom:Coordinate_Space_Indexed>
<geom:coordinate_space_frame_type>ROVER_NAV_FRAME</geom:coordinate_space_frame_type></geom:Coordinate_Space_Indexed>
</geom:Coordinate_Space_Reference></geom:Camera_Model_Parameters>
<geom:Coordinate_Space_Definition><local_identifier>ROVER_NAV_FRAME_{site}_11_0</local_identifier>
<geom:Coordinate_Space_Present><geom:Coordinate_Space_Indexed>
<geom:coordinate_space_frame_type>ROVER_NAV_FRAME</geom:coordinate_space_frame_type><geom:Coordinate_Space_Index>
<geom:index_id>SITE</geom:index_id><geom:index_value_number>{site}</geom:index_value_number>
</geom:Coordinate_Space_Index></geom:Coordinate_Space_Indexed></geom:Coordinate_Space_Present>
{vector("Vector_Origin_Offset", rover["ORIGIN_OFFSET_VECTOR"], "x_position y_position z_position")}
{quaternion}
<geom:Coordinate_Space_Reference><Local_Internal_Reference>
<local_identifier_reference>SITE_FRAME_{site}</local_identifier_reference>
</Local_Internal_Reference></geom:Coordinate_Space_Reference></geom:Coordinate_Space_Definition>
</geom:Geometry_Lander></geom:Geometry></Discipline_Area></Observation_Area>
<File_Area_Observational><File><file_name>{path.with_suffix(".img").name}</file_name></File>
<Array_2D_Image><offset unit="byte">0</offset><axes>2</axes><axis_index_order>Last Index Fastest</axis_index_order>
<Element_Array><data_type>{"UnsignedLSB2" if stored.itemsize == 2 else "UnsignedByte"}</data_type></Element_Array>
<Axis_Array><axis_name>Line</axis_name><elements>{lines}</elements><sequence_number>1</sequence_number></Axis_Array>
<Axis_Array><axis_name>Sample</axis_name><elements>{samples}</elements><sequence_number>2</sequence_number></Axis_Array>
</Array_2D_Image></File_Area_Observational></Product_Observational>
"""
    path.write_text(text)
    path.with_suffix(".img").write_bytes(stored.tobytes())


WRITERS = {".IMG": write_pds3, ".LBL": write_pds3, ".VIC": write_vicar, ".xml": write_pds4}
