"""`std_msgs/msg/UInt8MultiArray` as a DDS type, by the mapping of ROS 2 interfaces to IDL (design.ros2.org)."""

from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8, uint32


@dataclass
class MultiArrayDimension_(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayDimension_"):
    """A dimension of an array."""

    label: str
    size: uint32
    stride: uint32


@dataclass
class MultiArrayLayout_(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayLayout_"):
    """The layout of an array."""

    dim: sequence[MultiArrayDimension_]
    data_offset: uint32


@dataclass
class UInt8MultiArray_(IdlStruct, typename="std_msgs.msg.dds_.UInt8MultiArray_"):
    """An array of bytes."""

    layout: MultiArrayLayout_
    data: sequence[uint8]

    @classmethod
    def of(cls, label: str, data: bytes) -> "UInt8MultiArray_":
        """Return an array of one dimension."""
        size: Any = len(data)
        dimensions: Any = [MultiArrayDimension_(label, size, size)]
        content: Any = data  # cyclonedds takes any sequence
        return cls(MultiArrayLayout_(dimensions, 0), content)

    def read(self) -> tuple[str, bytes]:
        """Return the label of an array of one dimension, and its bytes; raises OSError for another one."""
        dimensions: Any = self.layout.dim
        content: Any = self.data
        data = bytes(content)
        if len(dimensions) != 1 or dimensions[0].size != len(data) or self.layout.data_offset:
            raise OSError("an array of another form than one dimension of bytes")
        return dimensions[0].label, data
