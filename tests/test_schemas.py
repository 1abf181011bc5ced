"""Schemas: every message goes into the log and comes back to the bit."""

import dataclasses as dc
import timeit
import typing

import numpy as np
import pytest
from log_samples import same
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from valve_drake import messages as ms
from valve_drake.recording import schemas

KINDS = [
    kind
    for kind in (*vars(ms).values(), schemas.Wrench, schemas.Vector)
    if isinstance(kind, type) and issubclass(kind, ms.Message) and kind is not ms.Message
]
STRANGE = np.array([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1.7976931348623157e308, 0.1, np.pi])


def random_message(kind: type[ms.Message], rng: np.random.Generator) -> ms.Message:
    hints = typing.get_type_hints(kind)
    return kind(**{f.name: random_value(f, hints[f.name], rng) for f in dc.fields(kind) if "image" != f.name != "data"})


def random_value(field: dc.Field, hint: object, rng: np.random.Generator) -> object:
    if "shape" in field.metadata:
        if field.metadata["optional"] and rng.random() < 0.5:
            return None
        least = 1 if field.metadata["optional"] else 0  # a group of no joints is commanded nothing
        shape = [int(rng.integers(least, 9)) if n < 0 else n for n in field.metadata["shape"]]
        return np.where(rng.random(shape) < 0.2, rng.choice(STRANGE, shape), rng.normal(size=shape))
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        return tuple(random_value(field, inner, rng) for _ in range(rng.integers(0, 4)))
    if issubclass(hint, ms.Message):
        return random_message(hint, rng)
    return {
        float: lambda: float(rng.choice(STRANGE)),
        int: lambda: int(rng.integers(-(2**63), 2**63 - 1)),
        bool: lambda: bool(rng.random() < 0.5),
        str: lambda: "".join(rng.choice(list("ab \n\u00e9\u2192\U0001f527"), 6)),
    }[hint]()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_message_comes_back_to_the_bit(kind):
    rng = np.random.default_rng(11)
    left_out = [name for name in schemas.UNLOGGED.get(kind, ()) if name not in ("image", "data")]
    for message in [kind(), *(random_message(kind, rng) for _ in range(30))]:
        message = dc.replace(message, **{name: getattr(kind(), name) for name in left_out})
        data = schemas.encode(message)
        back = schemas.decode(kind, data)
        assert same(message, back)
        assert schemas.encode(back) == data
        assert schemas.proto_class(kind).FromString(data).SerializeToString(deterministic=True) == data


def test_there_are_messages_of_every_module_of_the_program():
    assert len(KINDS) > 20
    assert all(schemas.kind_named(f"valve_drake.{kind.__name__}") is kind for kind in KINDS)
    assert schemas.kind_named("foxglove.Log") is None
    assert schemas.kind_named("valve_drake.Unheard") is None


def test_none_and_zeros_are_told_apart():
    back = schemas.decode(ms.Command, schemas.encode(ms.Command(torso=np.zeros(3))))
    assert np.array_equal(back.torso, np.zeros(3))
    assert back.left_arm is None


def test_empty_rows_keep_their_width():
    back = schemas.decode(ms.QuadEdges, schemas.encode(ms.QuadEdges()))
    assert back.points.shape == (0, 2)


def test_matrices_are_row_major():
    X = np.arange(12.0).reshape(3, 4)
    proto = schemas.proto_class(ms.GraspPlan).FromString(schemas.encode(ms.GraspPlan(X_BA=X)))
    assert list(proto.X_BA) == list(range(12))


def test_pixels_and_jpeg_stay_out_of_messages():
    frame = ms.CameraFrame("head_left", 0.5, 4, np.zeros((4, 4, 3), np.uint8), b"x" * 1000)
    message = ms.Segmentation(frame=frame)
    data = schemas.encode(message)
    assert len(data) < 100
    back = schemas.decode(ms.Segmentation, data).frame
    assert (back.camera, back.time, back.sequence, back.data) == ("head_left", 0.5, 4, b"")


def test_fields_that_an_older_log_lacks_get_their_defaults():
    wrench = schemas.encode(schemas.Wrench(time=2.0))
    older = schemas.proto_class(schemas.Wrench).FromString(wrench)  # shares but `time` with Status
    assert same(schemas.from_proto(ms.Status, older), ms.Status(time=2.0))


def test_schema_record_is_enough_to_decode():
    message = random_message(ms.SegmentationPair, np.random.default_rng(3))
    proto = schemas.proto_class(ms.SegmentationPair)
    record = Schema(id=1, name=proto.DESCRIPTOR.full_name, encoding="protobuf", data=schemas.schema_data(proto))
    read = DecoderFactory().decoder_for("protobuf", record)(schemas.encode(message))
    assert same(schemas.from_proto(ms.SegmentationPair, read), message)


def test_a_type_without_protobuf_is_refused_by_name():
    @dc.dataclass(frozen=True, eq=False)
    class Odd(ms.Message):
        table: dict = dc.field(default_factory=dict)

    with pytest.raises(TypeError, match="Odd.table"):
        schemas.encode(Odd())


def test_an_array_that_could_not_come_back_is_refused():
    @dc.dataclass(frozen=True, eq=False)
    class Doubtful(ms.Message):
        rows: np.ndarray = ms.array(-1, -1)

    with pytest.raises(TypeError, match="Doubtful.rows"):
        schemas.encode(Doubtful())


def test_a_command_is_encoded_within_30_microseconds():
    command = ms.Command(1.0, np.ones(2), np.ones(3), np.ones(6), np.ones(6), np.ones(2), np.ones(2))
    assert min(timeit.repeat(lambda: schemas.encode(command), number=200, repeat=10)) / 200 < 30e-6
