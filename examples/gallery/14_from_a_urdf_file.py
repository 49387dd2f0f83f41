"""
From a URDF file
================

Masses, inertias, damping and limits are read, and the equations derived; on the command line
``undertow simulate robot.urdf:x`` does it.
"""

import undertow as ut

URDF = """<robot name="cart_and_rod"><link name="rail"/>
<link name="cart"><inertial><mass value="0.5"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<link name="rod"><inertial><origin xyz="0 0 0.3"/><mass value="0.2"/>
 <inertia ixx="0.006" iyy="0.006" izz="0.0001"/></inertial></link>
<joint name="x" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
 <limit lower="-1.5" upper="1.5" effort="20" velocity="9"/><dynamics damping="0.1"/></joint>
<joint name="phi" type="continuous"><parent link="cart"/><child link="rod"/>
 <axis xyz="0 1 0"/></joint></robot>"""
rod = ut.modelling.from_urdf(URDF, actuated=["x"])
run = ut.Cascade(rod, ut.MinimumTime()).simulate(phi=ut.deg(20))
figure = run.plot()
