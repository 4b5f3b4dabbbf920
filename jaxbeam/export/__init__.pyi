from .c_program import CProgram as CProgram, export_c as export_c, write_c as write_c
from .fmi import (
    PARTS as PARTS,
    BeamSteps as BeamSteps,
    ControllerSteps as ControllerSteps,
    write_fmu as write_fmu,
)
from .gain_files import WRITERS as WRITERS, read_gains as read_gains, write_gains as write_gains
from .gains import Gains as Gains, export_gains as export_gains
