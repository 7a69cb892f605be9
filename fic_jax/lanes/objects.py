"""From LLVM IR to machine code in this process."""

import ctypes

import llvmlite.binding as llvm


def this_processor() -> llvm.TargetMachine:
    """The machine that LLVM compiles for."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=3, jit=True
    )


def features() -> str:
    """The instruction sets of this processor, in LLVM's words."""
    return str(llvm.get_host_cpu_features().flatten())


def register_bytes() -> int:
    """Width of this processor's vector registers."""
    return 64 if "+avx512f," in features() else 32 if "+avx," in features() else 16


def mask_registers() -> bool:
    """Whether this processor keeps one bit a lane in registers of their own."""
    return "+avx512f," in features()


def fused() -> bool:
    """Whether this processor has a fused multiply-add: its results differ in the last bits."""
    return "+fma," in features() or "+neon" in features() or "+fma4," in features()


class Function:
    """The function `run` of an object file, and the memory that holds it."""

    def __init__(self, machine: llvm.TargetMachine, code: bytes) -> None:
        empty = llvm.parse_assembly("")
        empty.triple, empty.data_layout = machine.triple, str(machine.target_data)
        self._memory = llvm.create_mcjit_compiler(empty, machine)  # as long as the function lives
        self._memory.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._memory.finalize_object()
        types = [*3 * [ctypes.c_void_p], *3 * [ctypes.c_int64]]
        self.call = ctypes.CFUNCTYPE(None, *types)(self._memory.get_function_address("run"))


def compiled(machine: llvm.TargetMachine, text: str) -> bytes:
    """The object file of a module.

    LLVM's optimisation passes do not run: the IR is already in SSA form, and they would turn masks
    into single bits.
    """
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return bytes(machine.emit_object(module))


def name(machine: llvm.TargetMachine) -> str:
    """The processor and instruction sets that object files for this machine need."""
    return f"{machine.triple} {llvm.get_host_cpu_name()} {features()}"
