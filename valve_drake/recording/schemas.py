"""Protobuf schemas made from the message dataclasses, so that log and messages.py cannot drift apart.

One mechanism for every subclass of messages.Message (and those of other modules), by the field's type:

| field of the dataclass     | protobuf field of `valve_drake.<Class>`, same name, numbered in order            |
|----------------------------|----------------------------------------------------------------------------------|
| float, int, bool, str, bytes | double, int64, bool, string, bytes                                             |
| array of a declared shape  | repeated double, row-major; -1 follows from the number of values; None is empty |
| tuple[str, ...]            | repeated string                                                                  |
| Message, tuple[Message, ...] | nested message, repeated nested message                                        |

A round trip gives back every bit. Pixels and encoded bytes of a CameraFrame stay out: they are logged
once, as foxglove.CompressedImage, and everything else refers to them by camera, time and sequence.
A log carries its own schemas, so a reader maps fields by name: what an older log lacks gets its default.
"""

import dataclasses as dc
import functools
import importlib
import math
import operator
import struct
import typing
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message as Proto
from mcap_protobuf.schema import build_file_descriptor_set

from valve_drake import messages
from valve_drake.messages import Message, array

PACKAGE = "valve_drake"
UNLOGGED: dict[type[Message], tuple[str, ...]] = {
    messages.CameraFrame: ("image", "data"),
    messages.RobotState: ("history",),  # what the messages before have said
}

_Field = descriptor_pb2.FieldDescriptorProto
_ONE_BYTE = [bytes([n]) for n in range(256)]
_SCALARS: dict[type, tuple[int, Callable[[Any], bytes], type]] = {  # protobuf's type, value -> bytes, and back
    float: (_Field.TYPE_DOUBLE, struct.Struct("<d").pack, float),
    int: (_Field.TYPE_INT64, lambda value: _varint(int(value) & 0xFFFF_FFFF_FFFF_FFFF), int),
    bool: (_Field.TYPE_BOOL, lambda value: _ONE_BYTE[bool(value)], bool),
    str: (_Field.TYPE_STRING, str.encode, str),
    bytes: (_Field.TYPE_BYTES, bytes, bytes),
}
_ZERO = bytes(8)  # 0.0
LISTS = 256  # different lists of texts whose bytes a field keeps, most come again; raise it for a log of many devices
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


class Encoded(NamedTuple):
    """A message that is already serialised."""

    kind: type[Proto]
    data: bytes


Loggable: TypeAlias = Message | Proto | Encoded


@dc.dataclass(frozen=True)
class _FieldCodec:
    name: str
    proto_type: int  # a TYPE_... of descriptor_pb2.FieldDescriptorProto
    repeated: bool
    put: Callable[[Any], bytes]  # the field's value as protobuf's bytes, without a tag
    from_proto: Callable[[Any], Any]
    size: int | None = None  # of the value's bytes, where it is always the same or nothing
    nested: type[Message] | None = None


@dc.dataclass(frozen=True)
class _Codec:
    proto: type[Proto]
    fields: tuple[_FieldCodec, ...]
    values: Callable[[Message], tuple[Any, ...]]  # of all fields
    writers: tuple[Callable[[Any], bytes], ...]  # for each: value -> bytes with tags


def proto_class(kind: type[Message]) -> type[Proto]:
    """The protobuf class of a message class."""
    return _codec(kind).proto


def encode(message: Message) -> bytes:
    """The message as the bytes that go into the log: what its protobuf class would serialise.

    Written directly from the arrays, which is two to four times as fast as using the protobuf class; encoding takes
    most of the time that logging costs the control loop.
    """
    codec = _codecs.get(type(message)) or _codec(type(message))
    return b"".join([write(value) for write, value in zip(codec.writers, codec.values(message))])


def serialized(message: Loggable) -> Encoded:
    """Any message that can be logged, as its protobuf class and its bytes."""
    if isinstance(message, Encoded):
        return message
    if isinstance(message, Message):
        data = encode(message)
        return Encoded(_codecs[type(message)].proto, data)
    return Encoded(type(message), message.SerializeToString())


def parsed(message: Encoded) -> Message | Proto:
    """The decoded message: one of the program's, or foxglove's."""
    kind = kind_named(message.kind.DESCRIPTOR.full_name)
    return message.kind.FromString(message.data) if kind is None else decode(kind, message.data)


def decode(kind: type[Message], data: bytes) -> Message:
    """The message from bytes that `encode` made."""
    return from_proto(kind, proto_class(kind).FromString(data))


def from_proto(kind: type[Message], proto: Proto) -> Message:
    """The message from protobuf of this or an older schema; fields that `proto` lacks get their default."""
    found = ((f, getattr(proto, f.name, None)) for f in _codec(kind).fields)
    return kind(**{f.name: f.from_proto(value) for f, value in found if value is not None})


def schema_data(proto: type[Proto]) -> bytes:
    """The FileDescriptorSet that an MCAP schema record holds for a protobuf class, own or foxglove's."""
    return build_file_descriptor_set(proto).SerializeToString(deterministic=True)


def kind_named(schema_name: str) -> type[Message] | None:
    """The message class of a schema's full name; None if it is not one of the program's."""
    package, _, name = schema_name.rpartition(".")
    return _kinds().get(name) if package == PACKAGE else None


def known(schema_name: str) -> bytes | None:
    """The schema data of one of the program's or Foxglove's messages by its full name; None for any other."""
    kind = kind_named(schema_name)
    if kind is not None:
        return schema_data(proto_class(kind))
    package, _, name = schema_name.rpartition(".")
    if package != "foxglove" or not name.isidentifier():
        return None
    try:
        module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
    except ImportError:
        return None
    return schema_data(getattr(module, name))


def _kinds() -> dict[str, type[Message]]:
    found, stack = {}, [Message]
    while stack:
        kinds = stack.pop().__subclasses__()
        found.update({kind.__name__: kind for kind in kinds})
        stack.extend(kinds)
    return found


_codecs: dict[type[Message], _Codec] = {}


def _codec(kind: type[Message]) -> _Codec:
    codec = _codecs.get(kind)
    if codec is None:
        codec = _codecs[kind] = _make_codec(kind)
    return codec


def _make_codec(kind: type[Message]) -> _Codec:
    hints = typing.get_type_hints(kind)
    logged = [f for f in dc.fields(kind) if f.name not in UNLOGGED.get(kind, ())]
    fields = tuple(_field_codec(kind, f, hints[f.name]) for f in logged)
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{kind.__name__}.proto", package=PACKAGE, syntax="proto3")
    inner = [f.nested for f in fields if f.nested is not None]
    file.dependency.extend(sorted({proto_class(nested).DESCRIPTOR.file.name for nested in inner}))
    message = file.message_type.add(name=kind.__name__)
    for number, field in enumerate(fields, start=1):
        label = _Field.LABEL_REPEATED if field.repeated else _Field.LABEL_OPTIONAL
        declared = message.field.add(name=field.name, number=number, type=field.proto_type, label=label)
        if field.nested:
            declared.type_name = f".{PACKAGE}.{field.nested.__name__}"
    _POOL.Add(file)
    descriptor = _POOL.FindMessageTypeByName(f"{PACKAGE}.{kind.__name__}")
    writers = tuple(_writer(number, f) for number, f in enumerate(fields, start=1))
    return _Codec(message_factory.GetMessageClass(descriptor), fields, _getter(fields), writers)


def _getter(fields: tuple[_FieldCodec, ...]) -> Callable[[Message], tuple[Any, ...]]:
    get = operator.attrgetter(*(f.name for f in fields))
    return get if len(fields) > 1 else lambda message: (get(message),)


def _field_codec(kind: type[Message], field: dc.Field[Any], hint: Any) -> _FieldCodec:
    if "shape" in field.metadata:
        return _array_codec(kind, field)
    repeated = typing.get_origin(hint) is tuple
    inner = typing.get_args(hint)[0] if repeated else hint
    nested = inner if isinstance(inner, type) and issubclass(inner, Message) else None
    if nested is None and (inner not in _SCALARS or (repeated and inner is not str)):
        raise TypeError(f"{kind.__name__}.{field.name}: no protobuf for {hint}")
    number: int
    put: Callable[[Any], bytes]
    back: Callable[[Any], Any]
    if nested is not None:
        number, put, back = _Field.TYPE_MESSAGE, encode, functools.partial(from_proto, nested)
    else:
        number, put, back = _SCALARS[inner]
    from_field = (lambda values: tuple(back(value) for value in values)) if repeated else back
    return _FieldCodec(field.name, number, repeated, put, from_field, nested=nested)


def _array_codec(kind: type[Message], field: dc.Field[Any]) -> _FieldCodec:
    shape, optional = field.metadata["shape"], field.metadata["optional"]
    if shape.count(-1) > 1:  # the shape could not be recovered from the number of values
        raise TypeError(f"{kind.__name__}.{field.name}: no protobuf for an array {shape}, optional={optional}")

    def put(value: np.ndarray | None) -> bytes:
        return b"" if value is None else value.tobytes()

    def shaped(values: Any) -> np.ndarray | None:
        return None if optional and len(values) == 0 else np.array(values, dtype=np.float64).reshape(shape)

    size = None if -1 in shape else 8 * math.prod(shape)
    return _FieldCodec(field.name, _Field.TYPE_DOUBLE, True, put, shaped, size)


# ---- protobuf's wire format


def _varint(n: int) -> bytes:
    if n < 0x80:
        return _ONE_BYTE[n]
    return _ONE_BYTE[n & 0x7F | 0x80] + _varint(n >> 7)


def _writer(number: int, field: _FieldCodec) -> Callable[[Any], bytes]:
    """The encoder of a field: tag and bytes; nothing for zero and empty values, which proto3 leaves out."""
    put = field.put
    sized = field.repeated or field.proto_type in (_Field.TYPE_STRING, _Field.TYPE_BYTES, _Field.TYPE_MESSAGE)
    wire_type = 2 if sized else 1 if field.proto_type == _Field.TYPE_DOUBLE else 0
    tag = _varint(number << 3 | wire_type)
    head = tag + _varint(field.size or 0)

    def of_fixed_size(value: np.ndarray | None) -> bytes:
        return b"" if value is None else head + value.tobytes()

    def double(value: float) -> bytes:
        data = put(value)
        return b"" if data == _ZERO else tag + data  # -0.0 is not zero

    def integer(value: int) -> bytes:
        return tag + put(value) if value else b""

    def with_size(value: Any) -> bytes:
        data = put(value)
        return tag + _varint(len(data)) + data if data else b""

    def message(value: Any) -> bytes:
        data = put(value)
        return tag + _varint(len(data)) + data

    def each(values: tuple[Any, ...]) -> bytes:
        return b"".join([message(value) for value in values]) if values else b""

    if field.size:
        return of_fixed_size
    if field.repeated and field.proto_type != _Field.TYPE_DOUBLE:
        return each if field.nested else functools.lru_cache(LISTS)(each)
    if field.nested:
        return message
    return with_size if sized else double if wire_type == 1 else integer


for _kind in _kinds().values():  # a field without a protobuf type fails when the package is imported
    proto_class(_kind)
