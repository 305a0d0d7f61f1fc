"""Read an SDF world with Drake and print bodies, joints and places at a value of each hinge, as JSON."""

# pyright: reportMissingImports=false

import json
import sys

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

path, value = sys.argv[1], float(sys.argv[2])
plant = MultibodyPlant(0.001)
models = Parser(plant).AddModels(path)
plant.Finalize()
context = plant.CreateDefaultContext()
bodies, joints = {}, {}
for model in models:
    for index in plant.GetJointIndices(model):
        joint = plant.get_joint(index)
        kind = type(joint).__name__
        joints[joint.name()] = [kind, *map(float, joint.position_lower_limits()), *joint.position_upper_limits()]
        if kind == "RevoluteJoint":
            joint.set_angle(context, value)
    for index in plant.GetBodyIndices(model):
        body = plant.get_body(index)
        pose = plant.EvalBodyPoseInWorld(context, body)
        name = f"{plant.GetModelInstanceName(model)}/{body.name()}"
        bodies[name] = [body.default_mass(), *pose.translation(), *pose.rotation().matrix()[:, 0]]
gravity = plant.gravity_field().gravity_vector().tolist()
print(json.dumps({"bodies": bodies, "joints": joints, "gravity": gravity, "actuators": plant.num_actuators()}))
