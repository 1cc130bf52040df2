"""LeRobot policy whose actions are planned by a remote CPN planner, and environments with a goal image.

LeRobot imports the package as a plugin.
"""

from lerobot_policy_cpn.configuration_cpn import CpnConfig
from lerobot_policy_cpn.environment_configuration import CpnEnvConfig
from lerobot_policy_cpn.modeling_cpn import CpnPolicy
from lerobot_policy_cpn.processor_cpn import make_cpn_pre_post_processors

__all__ = ["CpnConfig", "CpnEnvConfig", "CpnPolicy", "make_cpn_pre_post_processors"]
