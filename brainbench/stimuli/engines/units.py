"""Units of the engines: mm, ms and mg, so mN and µN·m, keep every number near one."""

MILLI = 1e3  # millimetres in a metre, milliseconds in a second, millinewtons in a newton
MICRO = 1e6  # milligrams in a kilogram, µN·m in a newton metre
