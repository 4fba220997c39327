"""Named tuples of arrays that compiled code is given as one pointer.

Numba passes a tuple by value: every array of it as some ten numbers, in every call. A world has seventy arrays, so
passing it took more than half of the time of a step. The named tuples marked with ``by_reference`` are read once from
their Python objects, when Python calls a kernel. What the kernel calls is given their address. Kernels read fields by
name as of any named tuple; they cannot take these apart by position.
"""

from __future__ import annotations

import hashlib
from typing import Any, TypeVar

from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.types.containers import BaseNamedTuple, BaseTuple
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    register_model,
    typeof_impl,
    unbox,
)

Class = TypeVar("Class", bound=type)


class Reference(types.Type):
    """The address of a named tuple; ``target`` is Numba's type of that."""

    def __init__(self, target: BaseNamedTuple) -> None:
        self.target = target
        # The names of all arrays' types would be in the name of every compiled function.
        digest = hashlib.sha256(target.name.encode()).hexdigest()[:16]
        super().__init__(f"{target.instance_class.__name__}_{digest}")


def by_reference(named_tuple: Class) -> Class:
    """Mark a ``NamedTuple`` class: compiled code is given the address of its tuples."""

    @typeof_impl.register(named_tuple)
    def _typeof(value: Any, context: Any) -> Reference:
        return Reference(BaseTuple.from_types([typeof_impl(field, context) for field in value], named_tuple))

    return named_tuple


@register_model(Reference)
class _Pointer(models.PrimitiveModel):
    def __init__(self, manager: Any, reference: Reference) -> None:
        super().__init__(manager, reference, manager.lookup(reference.target).get_value_type().as_pointer())


@unbox(Reference)
def _read(reference: Reference, python_object: Any, c: Any) -> NativeValue:
    """The tuple's fields, put into the frame of what Python calls, which outlives the kernel.

    No reference is counted, also not in code that counts: who calls holds the tuple, and nobody would give them back.
    """
    counts, c.context.enable_nrt = c.context.enable_nrt, False
    try:
        read = c.unbox(reference.target, python_object)
    finally:
        c.context.enable_nrt = counts
    address = cgutils.alloca_once_value(c.builder, read.value)
    return NativeValue(address, is_error=read.is_error, cleanup=read.cleanup)


@infer_getattr
class _Fields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, reference: Reference, name: str) -> types.Type | None:
        fields = reference.target.fields
        return reference.target[fields.index(name)] if name in fields else None


@lower_getattr_generic(Reference)
def _load(context: Any, builder: Any, reference: Reference, address: Any, name: str) -> Any:
    place = reference.target.fields.index(name)
    return builder.load(cgutils.gep_inbounds(builder, address, 0, place))
