"""The closed loop as the kernel does not decide it yet: a held input, a plant in a box.

:mod:`.loop` has the equations, :mod:`.tube` integrates sets of them, :mod:`.run` follows
neighbouring boxes until they lie in a terminal set (:mod:`.terminal`); :mod:`.sampled_data` holds
the input.
"""
