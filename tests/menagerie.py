"""The two models of MuJoCo's Menagerie that TorchRL's `CubeBowlEnv` composes, without their meshes.

The frames and limits of the UR5e are the Menagerie's own; the gripper has the names and the eight joints that the
environment asks for, and closes by two slides.
"""

UR5E = """
<mujoco model="ur5e">
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast"/>
  <default>
    <default class="ur5e">
      <joint axis="0 1 0" range="-6.28319 6.28319" armature="0.1"/>
      <position ctrlrange="-6.2831 6.2831" kp="2000" kv="400" forcerange="-150 150"/>
      <default class="size1"><position kp="500" kv="100" forcerange="-28 28"/></default>
      <geom type="capsule" size="0.03 0.05" contype="0" conaffinity="0" mass="2"/>
    </default>
  </default>
  <worldbody>
    <body name="base" quat="0 0 0 -1" childclass="ur5e" gravcomp="1">
      <body name="shoulder_link" pos="0 0 0.163" gravcomp="1">
        <joint name="shoulder_pan_joint" axis="0 0 1"/><geom/>
        <body name="upper_arm_link" pos="0 0.138 0" quat="1 0 1 0" gravcomp="1">
          <joint name="shoulder_lift_joint"/><geom/>
          <body name="forearm_link" pos="0 -0.131 0.425" gravcomp="1">
            <joint name="elbow_joint" range="-3.1415 3.1415"/><geom/>
            <body name="wrist_1_link" pos="0 0 0.392" quat="1 0 1 0" gravcomp="1">
              <joint name="wrist_1_joint"/><geom mass="1"/>
              <body name="wrist_2_link" pos="0 0.127 0" gravcomp="1">
                <joint name="wrist_2_joint" axis="0 0 1"/><geom mass="1"/>
                <body name="wrist_3_link" pos="0 0 0.1" gravcomp="1">
                  <joint name="wrist_3_joint"/><geom mass="0.5"/>
                  <site name="attachment_site" pos="0 0.1 0" quat="-1 1 0 0"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position class="ur5e" name="shoulder_pan" joint="shoulder_pan_joint"/>
    <position class="ur5e" name="shoulder_lift" joint="shoulder_lift_joint"/>
    <position class="ur5e" name="elbow" joint="elbow_joint" ctrlrange="-3.1415 3.1415"/>
    <position class="size1" name="wrist_1" joint="wrist_1_joint"/>
    <position class="size1" name="wrist_2" joint="wrist_2_joint"/>
    <position class="size1" name="wrist_3" joint="wrist_3_joint"/>
  </actuator>
</mujoco>
"""


def finger(side, sign):
    """A finger: a slide that its pads are on, and three more joints that nothing drives."""
    still = "".join(f'<joint name="{side}_{name}" type="slide" axis="0 0 1" range="0 0.001"/>' for name in "abc")
    box = 'type="box" size="0.016 0.01 0.025" mass="0.02"'
    pads = "".join(f'<geom name="{side}_pad{number}" {box}/>' for number in (1, 2))
    return f"""
      <body name="{side}_finger" pos="0 {0.05 * sign} 0.145" gravcomp="1">
        <joint name="{side}_driver" type="slide" axis="0 {-sign} 0" range="0 0.045" damping="5"/>{still}{pads}
      </body>"""


GRIPPER = f"""
<mujoco model="2f85">
  <compiler angle="radian" autolimits="true"/>
  <default><default class="2f85"><joint armature="0.01" damping="5" stiffness="50"/></default></default>
  <worldbody>
    <body name="base_mount" childclass="2f85" gravcomp="1">
      <geom name="mount" type="cylinder" size="0.03 0.02" mass="0.3" contype="0" conaffinity="0"/>
      <site name="pinch" pos="0 0 0.156"/>{finger("left", 1)}{finger("right", -1)}
    </body>
  </worldbody>
  <tendon><fixed name="split"><joint joint="left_driver" coef="0.5"/><joint joint="right_driver" coef="0.5"/></fixed>
  </tendon>
  <actuator>
    <general name="fingers_actuator" tendon="split" ctrlrange="0 255" gainprm="0.03" biastype="none"/>
  </actuator>
</mujoco>
"""


def write(folder):
    """Write both below ``folder`` as the Menagerie has them."""
    for name, file, text in (("universal_robots_ur5e", "ur5e.xml", UR5E), ("robotiq_2f85", "2f85.xml", GRIPPER)):
        (folder / name).mkdir(parents=True)
        (folder / name / file).write_text(text.strip())
    return folder
