"""Protobuf schemas made from the message dataclasses, so that log and messages.py cannot drift apart.

One mechanism for every subclass of messages.Message (and those of other modules), by the field's type:

| field of the dataclass     | protobuf field of `valve_drake.<Class>`, same name, numbered in order            |
|----------------------------|----------------------------------------------------------------------------------|
| float, int, bool, str, bytes | double, int64, bool, string, bytes                                             |
| array of a declared shape  | repeated double, row-major; a length -1 follows from the number of values; None is empty |
| tuple[str, ...]            | repeated string                                                                  |
| Message, tuple[Message, ...] | nested message, repeated nested message                                        |

A round trip gives back every bit. Pixels and encoded bytes of a CameraFrame stay out: they are logged
once, as foxglove.CompressedImage, and everything else refers to them by camera, time and sequence.
A log carries its own schemas, so a reader maps fields by name: what an older log lacks gets its default.
"""

import dataclasses as dc
import functools
import types
import typing
from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message as Proto
from mcap_protobuf.schema import build_file_descriptor_set

from valve_drake import messages
from valve_drake.messages import Message, array

PACKAGE = "valve_drake"
UNLOGGED = {messages.CameraFrame: ("image", "data")}

_Field = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    float: _Field.TYPE_DOUBLE,
    int: _Field.TYPE_INT64,
    bool: _Field.TYPE_BOOL,
    str: _Field.TYPE_STRING,
    bytes: _Field.TYPE_BYTES,
}
_POOL = descriptor_pool.DescriptorPool()


@dc.dataclass(frozen=True, eq=False)
class Wrench(Message):
    """A station's wrench port in the log: load felt by the sensor, at and in the sensor's frame."""

    time: float = 0.0
    torque: np.ndarray = array(3)  # [N m]
    force: np.ndarray = array(3)  # [N]


@dc.dataclass(frozen=True, eq=False)
class Vector(Message):
    """Any other vector port in the log, with a name for each value."""

    time: float = 0.0
    names: tuple[str, ...] = ()
    values: np.ndarray = array(-1)


@dc.dataclass(frozen=True)
class _FieldCodec:
    name: str
    type: int  # of descriptor_pb2.FieldDescriptorProto
    repeated: bool
    to_proto: Callable[[Any], Any]
    from_proto: Callable[[Any], Any]
    nested: type[Message] | None = None


@dc.dataclass(frozen=True)
class _Codec:
    proto: type[Proto]
    fields: tuple[_FieldCodec, ...]
    encoders: tuple[tuple[str, Callable[[Any], Any]], ...]  # the fields' names and `to_proto`


def proto_class(kind: type[Message]) -> type[Proto]:
    """The protobuf class of a message class."""
    return _codec(kind).proto


def to_proto(message: Message) -> Proto:
    """The message as protobuf."""
    codec = _codec(type(message))
    return codec.proto(**{name: convert(getattr(message, name)) for name, convert in codec.encoders})


def from_proto(kind: type[Message], proto: Proto) -> Message:
    """The message from protobuf of this or an older schema; fields that `proto` lacks get their default."""
    found = ((f, getattr(proto, f.name, None)) for f in _codec(kind).fields)
    return kind(**{f.name: f.from_proto(value) for f, value in found if value is not None})


def encode(message: Message) -> bytes:
    """The message as the bytes that go into the log."""
    return to_proto(message).SerializeToString()


def decode(kind: type[Message], data: bytes) -> Message:
    """The message from bytes that `encode` made."""
    return from_proto(kind, proto_class(kind).FromString(data))


def schema_data(proto: type[Proto]) -> bytes:
    """The FileDescriptorSet that an MCAP schema record holds for a protobuf class, own or foxglove's."""
    return build_file_descriptor_set(proto).SerializeToString(deterministic=True)


def kind_named(schema_name: str) -> type[Message] | None:
    """The message class of a schema's full name; None if it is not one of the program's."""
    package, _, name = schema_name.rpartition(".")
    return _kinds().get(name) if package == PACKAGE else None


def _kinds() -> dict[str, type[Message]]:
    found, stack = {}, [Message]
    while stack:
        kinds = stack.pop().__subclasses__()
        found.update({kind.__name__: kind for kind in kinds})
        stack.extend(kinds)
    return found


@functools.cache
def _codec(kind: type[Message]) -> _Codec:
    hints = typing.get_type_hints(kind)
    fields = tuple(
        _field_codec(kind, f, hints[f.name]) for f in dc.fields(kind) if f.name not in UNLOGGED.get(kind, ())
    )
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{kind.__name__}.proto", package=PACKAGE, syntax="proto3")
    file.dependency.extend(
        sorted({proto_class(f.nested).DESCRIPTOR.file.name for f in fields if f.nested is not None})
    )
    message = file.message_type.add(name=kind.__name__)
    for number, field in enumerate(fields, start=1):
        label = _Field.LABEL_REPEATED if field.repeated else _Field.LABEL_OPTIONAL
        declared = message.field.add(name=field.name, number=number, type=field.type, label=label)
        if field.nested is not None:
            declared.type_name = f".{PACKAGE}.{field.nested.__name__}"
    _POOL.Add(file)
    descriptor = _POOL.FindMessageTypeByName(f"{PACKAGE}.{kind.__name__}")
    encoders = tuple((f.name, f.to_proto) for f in fields)
    return _Codec(message_factory.GetMessageClass(descriptor), fields, encoders)


def _field_codec(kind: type[Message], field: dc.Field, hint: Any) -> _FieldCodec:
    if "shape" in field.metadata:
        return _array_codec(kind, field)
    repeated = typing.get_origin(hint) is tuple
    inner = typing.get_args(hint)[0] if repeated else hint
    if isinstance(inner, types.GenericAlias) or not isinstance(inner, type):
        raise TypeError(f"{kind.__name__}.{field.name}: no protobuf for {hint}")
    if issubclass(inner, Message):
        back = functools.partial(from_proto, inner)
        convert, back = (_all(to_proto), _all(back)) if repeated else (to_proto, back)
        return _FieldCodec(field.name, _Field.TYPE_MESSAGE, repeated, convert, back, inner)
    if inner not in _SCALARS or (repeated and inner is not str):
        raise TypeError(f"{kind.__name__}.{field.name}: no protobuf for {hint}")
    convert = tuple if repeated else inner
    return _FieldCodec(field.name, _SCALARS[inner], repeated, convert, convert)


def _all(convert: Callable[[Any], Any]) -> Callable[[Any], tuple]:
    return lambda values: tuple(convert(value) for value in values)


def _array_codec(kind: type[Message], field: dc.Field) -> _FieldCodec:
    shape, optional = field.metadata["shape"], field.metadata["optional"]
    if shape.count(-1) > (0 if optional else 1):
        # Its length could not be told from the number of values, or no rows from None.
        raise TypeError(f"{kind.__name__}.{field.name}: no protobuf for an array {shape}, optional={optional}")

    def flat(value: np.ndarray | None) -> list[float]:
        return [] if value is None else value.ravel().tolist()

    def shaped(values: Any) -> np.ndarray | None:
        return None if optional and len(values) == 0 else np.array(values, dtype=np.float64).reshape(shape)

    return _FieldCodec(field.name, _Field.TYPE_DOUBLE, True, flat, shaped)


for _kind in _kinds().values():
    _codec(_kind)
