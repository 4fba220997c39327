"""Functions that only kernels call become machine code within these, once.

Numba makes every compiled function ready to run by itself: with all that it calls it is optimised and turned into
machine code, and again within each of its callers. Of functions below kernels that code is never run. So their compiled
form ends as what LLVM links, which took half of the time of compiling and more. Kernels are optimised as a whole
either way, so their results and their speed are the same.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding
from numba.core.caching import CompileResultCacheImpl
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult


class PartLibrary(JITCodeLibrary):
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

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """What is kept on disk."""
        return self.name, "part", self._get_module_for_linking().as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, bytes]) -> PartLibrary:
        name, _, bitcode = state
        made = cls(codegen, name)
        made._final_module = made._shared_module = binding.parse_bitcode(bitcode)
        made._finalize_final_module()
        return made

    def _optimize_final_module(self) -> None:
        """Left to the kernel's."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True


class PartCompiler(Compiler):
    """Numba's compiler, into a ``PartLibrary``."""

    def define_pipelines(self) -> Any:
        """See the class."""
        self.state.library = PartLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return super().define_pipelines()


class PartFiles(CompileResultCacheImpl):
    """Reads a ``PartLibrary`` from what its ``serialize_using_object_code`` gave."""

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> CompileResult:
        """See the class."""
        return CompileResult._rebuild(_Reading(target_context), *payload)._replace(target_context=target_context)


class _Reading:
    """A target context whose code generator makes a ``PartLibrary`` of what was kept."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def codegen(self) -> _Reading:
        return self

    def unserialize_library(self, state: tuple[str, str, bytes]) -> PartLibrary:
        return PartLibrary._unserialize(self._context.codegen(), state)
