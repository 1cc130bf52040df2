"""Decimates the meshes of every installed task, which puts them into the cache."""

from cpn_sim_worker.jenga import JengaScene
from cpn_sim_worker.meshes import decimated
from cpn_sim_worker.metaworld_scene import MetaWorldScene
from cpn_sim_worker.render import DECIMATION
from cpn_sim_worker.tasks import JENGA_TASKS, METAWORLD_TASKS, MissingExtraError

for task in METAWORLD_TASKS:
    decimated(MetaWorldScene(task).model, DECIMATION)
for task in JENGA_TASKS:
    try:
        decimated(JengaScene(task).model, DECIMATION)
    except MissingExtraError as error:
        print(f"{task} is left out: {error}")
