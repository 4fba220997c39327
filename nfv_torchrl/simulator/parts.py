"""What compiled functions become, so that nothing is made into machine code twice.

Numba makes every compiled function ready to run by itself: with all that it calls it is optimised and turned into
machine code, and again within each of its callers. Here there are three kinds instead.

*Kernels* are called from Python.

*Parts* are called by kernels only, so machine code of their own would never be run. Their compiled form ends as what
LLVM links, which took half of the time of compiling and more. Kernels are optimised as a whole either way, so their
results and their speed are the same.

*Shared* functions are called by several kernels, and take so much longer to run than to call that it does not matter
whether they are optimised together with their callers. They have machine code of their own, which kernels refer to by
its name.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from llvmlite import binding
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult

Names = dict[str, tuple[str, str, tuple[Any, ...]]]
"""Shared functions by the names of their machine code: the module, the name and the types of the arguments."""


class StaleCodeError(Exception):
    """Kept code refers to machine code that has been compiled anew."""


class KernelLibrary(JITCodeLibrary):
    """A function and all that it calls, but for shared functions.

    Attributes:
        refers: the shared functions that it calls, itself or through its parts.
    """

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self.refers: Names = {}

    def to_callers(self) -> Names:
        """The shared functions that code refers to which calls this."""
        return self.refers

    def add_linking_library(self, library: Any) -> None:
        """Link it, or refer to it if it is shared."""
        library._ensure_finalized()
        if isinstance(library, KernelLibrary):
            self.refers.update(library.to_callers())
        if not isinstance(library, SharedLibrary):
            super().add_linking_library(library)

    def serialize_using_object_code(self) -> tuple[Any, ...]:
        """What is kept on disk."""
        kept = super().serialize_using_object_code()[2]
        return self.name, type(self).__name__, self.refers, kept

    def read(self, kept: Any) -> None:
        """Make ready what was kept."""
        code, bitcode = kept
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._shared_module = binding.parse_bitcode(bitcode)
        self._finalize_final_module()
        self._codegen._engine._load_defined_symbols(self._shared_module)


class SharedLibrary(KernelLibrary):
    """A function that has machine code of its own for kernels to refer to.

    Attributes:
        itself: its module, its name and the types of its arguments.
    """

    itself: tuple[str, str, tuple[Any, ...]]

    def to_callers(self) -> Names:
        """See ``KernelLibrary``."""
        return self.own

    def add_ir_module(self, ir_module: Any) -> None:
        """Of the functions in it, the one that others see is this one."""
        (name,) = (each.name for each in ir_module.functions if not each.is_declaration and not each.linkage)
        self.own = {name: self.itself}
        super().add_ir_module(ir_module)

    def serialize_using_object_code(self) -> tuple[Any, ...]:
        """What is kept on disk."""
        *start, kept = super().serialize_using_object_code()
        return *start, (self.own, kept)

    def read(self, kept: Any) -> None:
        """Make ready what was kept."""
        self.own, kept = kept
        super().read(kept)


class PartLibrary(KernelLibrary):
    """A function and all that it calls, to be linked into a kernel; there is no machine code of it."""

    @property
    def codegen(self) -> PartLibrary:
        """Who is told of the address of the function's environment: nobody, since it is nowhere in memory."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """See ``codegen``."""

    def get_pointer_to_function(self, name: str) -> int:
        """0: none is defined that could be called."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple[Any, ...]:
        """What is kept on disk."""
        return self.name, type(self).__name__, self.refers, self._get_module_for_linking().as_bitcode()

    def read(self, kept: Any) -> None:
        """Make ready what was kept."""
        self._final_module = self._shared_module = binding.parse_bitcode(kept)
        self._finalize_final_module()

    def _optimize_final_module(self) -> None:
        """Left to the kernel's."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


KINDS = {kind.__name__: kind for kind in (KernelLibrary, SharedLibrary, PartLibrary)}


class KernelCompiler(Compiler):
    """Numba's compiler, into a ``KernelLibrary``."""

    library: type[KernelLibrary] = KernelLibrary

    def define_pipelines(self) -> Any:
        """See the class."""
        function = self.state.func_id
        made = self.library(self.state.targetctx.codegen(), function.func_qualname)
        if isinstance(made, SharedLibrary):
            made.itself = function.modname, function.func_qualname, tuple(self.state.args)
        made.enable_object_caching()
        self.state.library = made
        return super().define_pipelines()


class SharedCompiler(KernelCompiler):
    """The same into a ``SharedLibrary``."""

    library = SharedLibrary


class PartCompiler(KernelCompiler):
    """The same into a ``PartLibrary``."""

    library = PartLibrary


class KeptFiles(CompileResultCacheImpl):
    """Reads what the libraries' ``serialize_using_object_code`` gave."""

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> CompileResult:
        """See the class."""
        return CompileResult._rebuild(_Reading(target_context), *payload)._replace(target_context=target_context)


class _Reading:
    """A target context whose code generator makes libraries of what was kept."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> _Reading:
        return self

    def unserialize_library(self, state: tuple[str, str, Names, Any]) -> KernelLibrary:
        name, kind, refers, kept = state
        for called, (module, function, types) in refers.items():
            shared = getattr(import_module(module), function)
            shared.compile(types)
            if called not in shared.overloads[types].library.to_callers():
                raise StaleCodeError(called)
        made = KINDS[kind](self._context.codegen(), name)
        made.refers = refers
        made.read(kept)
        return made
