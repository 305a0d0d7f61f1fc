"""Jointed bodies of a model: which joints have a servo, and what moves."""

from cgwm.schemas import ArticulationModel, JointModel


def test_a_joint_of_any_stiffness_has_a_servo_and_what_is_welded_to_a_fixed_root_does_not_move() -> None:
    joints = [
        JointModel(name="weld", kind="fixed", link="plate", parent="base"),
        JointModel(name="soft", kind="hinge", link="arm", parent="plate", stiffness=0.02),
        JointModel(name="loose", kind="hinge", link="hand", parent="arm"),
        JointModel(name="stiff", kind="slide", link="finger", parent="hand", stiffness=50.0),
        JointModel(name="nail", kind="fixed", link="tip", parent="finger"),
    ]
    fixed, free = (ArticulationModel(name="robot", root="base", base=base, joints=joints) for base in ("fixed", "free"))
    assert fixed.servos == free.servos == ("soft", "stiff")
    assert fixed.moving_links == ("arm", "hand", "finger", "tip")
    assert free.moving_links == free.links == ("base", "plate", "arm", "hand", "finger", "tip")
