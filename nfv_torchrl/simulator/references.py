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
from numba.np.numpy_support import as_dtype

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
    Each field is read into its place. Numba would make one value of all of them first, of a thousand numbers, with
    which LLVM was busy longer than with most kernels.
    """
    counts, c.context.enable_nrt = c.context.enable_nrt, False
    try:
        address = cgutils.alloca_once(c.builder, c.context.get_value_type(reference.target))
        failed = cgutils.false_bit
        for number, kind in enumerate(reference.target):
            place = cgutils.gep_inbounds(c.builder, address, 0, number)
            read = _read_array if isinstance(kind, types.Array) else _read_value
            failed = c.builder.or_(failed, read(kind, c.pyapi.tuple_getitem(python_object, number), place, c))
        with c.builder.if_then(failed, likely=False):
            message = f"a field of {reference.target.instance_class.__name__} is not what it was when it was compiled"
            c.pyapi.err_set_string("PyExc_TypeError", message)
    finally:
        c.context.enable_nrt = counts
    return NativeValue(address, is_error=failed)


def _read_value(kind: types.Type, item: Any, place: Any, c: Any) -> Any:
    """Whether reading failed."""
    read = c.unbox(kind, item)
    assert read.cleanup is None, f"{kind} would have to be given back"
    c.builder.store(read.value, place)
    return read.is_error


def _read_array(kind: types.Array, item: Any, place: Any, c: Any) -> Any:
    """The same of an array, as Numba's ``unbox_array`` does it."""
    code = c.pyapi.numba_array_adaptor(item, c.builder.bitcast(place, c.pyapi.voidptr))
    found = c.context.make_array(kind)(c.context, c.builder, ref=place).itemsize
    other = c.builder.icmp_unsigned("!=", found, found.type(as_dtype(kind.dtype).itemsize))
    return c.builder.or_(cgutils.is_not_null(c.builder, code), other)


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
