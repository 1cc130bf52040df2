"""The manifests of `deploy/kubernetes` against Kubernetes' schemas, each other, and `docker-compose.yml`."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

ROOT = Path(__file__).parents[2]
KUBERNETES = ROOT / "deploy/kubernetes"
SERVICES = {  # by pod, as docker-compose.yml calls them
    "router": "router",
    "planner": "planner-0",
    "trainer": "trainer",
    "sim-worker": "sim-worker",
    "evaluator": "evaluator",
    "prometheus": "prometheus",
}
VERSIONS = ["1.29", "1.33", "1.37"]

Manifest = dict[str, Any]


@pytest.fixture(scope="session")
def kustomization(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder, with empty certificates."""
    folder = tmp_path_factory.mktemp("kubernetes") / "kubernetes"
    shutil.copytree(KUBERNETES, folder, ignore=shutil.ignore_patterns("certificates"))
    for secret in read(folder / "kustomization.yaml")[0]["secretGenerator"]:
        for file in secret["files"]:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).touch()
    return folder


def built(folder: Path) -> list[Manifest]:
    """What `kubectl apply -k` would send."""
    build = subprocess.run(["kubectl", "kustomize", str(folder)], check=True, capture_output=True, text=True)
    assert build.stderr == ""
    return list(yaml.safe_load_all(build.stdout))


@pytest.fixture(scope="session")
def manifests(kustomization: Path) -> list[Manifest]:
    return built(kustomization)


@pytest.fixture(scope="session")
def compose() -> Manifest:
    text = (ROOT / "docker-compose.yml").read_text()
    return yaml.safe_load(re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text))["services"]


def read(path: Path) -> list[Manifest]:
    return list(yaml.safe_load_all(path.read_text()))


def of_kind(manifests: list[Manifest], kind: str) -> dict[str, Manifest]:
    return {manifest["metadata"]["name"]: manifest for manifest in manifests if manifest["kind"] == kind}


def pods(manifests: list[Manifest]) -> dict[str, Manifest]:
    """The pod templates by name."""
    owners = of_kind(manifests, "StatefulSet") | of_kind(manifests, "Job")
    return {name: owner["spec"]["template"] for name, owner in owners.items()}


def container(pod: Manifest) -> Manifest:
    (only,) = pod["spec"]["containers"]
    return only


def environment(manifests: list[Manifest], pod: Manifest) -> dict[str, str]:
    """Variables of a pod; a field of the pod stands as its path."""
    found: dict[str, str] = {}
    for source in container(pod).get("envFrom", []):
        found |= of_kind(manifests, "ConfigMap")[source["configMapRef"]["name"]]["data"]
    for variable in container(pod).get("env", []):
        found[variable["name"]] = variable.get("value") or variable["valueFrom"]["fieldRef"]["fieldPath"]
    return found


def ports(pod: Manifest) -> dict[str, int]:
    return {port["name"]: port["containerPort"] for port in container(pod).get("ports", [])}


def selected(manifests: list[Manifest], selector: dict[str, str]) -> list[str]:
    """Pods with these labels."""
    labels = {name: pod["metadata"]["labels"] for name, pod in pods(manifests).items()}
    return [name for name in labels if selector.items() <= labels[name].items()]


def mounted_files(manifests: list[Manifest], pod: Manifest) -> set[str]:
    """Files that a pod finds in secrets and configurations."""
    mounts = {mount["name"]: mount for mount in container(pod)["volumeMounts"]}
    files: set[str] = set()
    for volume in pod["spec"]["volumes"]:
        mount = mounts[volume["name"]]
        if "secret" in volume:
            keys = of_kind(manifests, "Secret")[volume["secret"]["secretName"]]["data"]
        elif "configMap" in volume:
            keys = of_kind(manifests, "ConfigMap")[volume["configMap"]["name"]]["data"]
        else:
            continue
        files |= {mount["mountPath"]} if "subPath" in mount else {f"{mount['mountPath']}/{key}" for key in keys}
    return files


@pytest.mark.parametrize("version", VERSIONS)
def test_schemas_know_every_field(manifests: list[Manifest], version: str) -> None:
    for manifest in [*manifests, *read(KUBERNETES / "report.yaml")]:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_schemas_refuse_a_field_they_do_not_know(manifests: list[Manifest]) -> None:
    job = of_kind(manifests, "Job")["evaluator"]
    with pytest.raises(kubernetes_validate.ValidationError, match="backOffLimit"):
        kubernetes_validate.validate(job | {"spec": job["spec"] | {"backOffLimit": 1}}, VERSIONS[-1], strict=True)


def test_pods_are_the_services_of_compose(manifests: list[Manifest], compose: Manifest) -> None:
    found = pods(manifests)
    assert found.keys() == SERVICES.keys()
    for name, pod in found.items():
        service = compose[SERVICES[name]]
        assert container(pod)["image"] == service["image"]
        limit = container(pod)["resources"]["limits"]["memory"]
        assert limit.removesuffix("i").lower() == service["mem_limit"], name


def test_the_documented_kustomization_renames_every_image_of_the_project(kustomization: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/kubernetes.md").read_text(), re.DOTALL)
    mine = kustomization.parent / "mine"
    mine.mkdir()
    (mine / "kustomization.yaml").write_text(text)
    images = {container(pod)["image"] for pod in pods(built(mine)).values()}
    names = ["planner", "trainer", "sim-worker", "evaluator", "prometheus"]
    assert images == {"eclipse/zenoh:1.10.2", *(f"registry.example/cpn-{name}:1" for name in names)}


def test_variables_are_those_of_compose(manifests: list[Manifest], compose: Manifest) -> None:
    for name, pod in pods(manifests).items():
        expected = dict(compose[SERVICES[name]].get("environment", {}))
        if name == "planner":
            expected["CPN_PLANNER_NAME"] = "metadata.name"
        if name == "sim-worker":
            expected["POD_NAME"] = "metadata.name"
        assert environment(manifests, pod) == expected, name


def test_variables_name_files_that_are_mounted(manifests: list[Manifest]) -> None:
    for pod in pods(manifests).values():
        files = mounted_files(manifests, pod)
        named = {value for value in environment(manifests, pod).values() if value.startswith("/certificates/")}
        assert named <= files
    router = pods(manifests)["router"]
    assert container(router)["args"][1] in mounted_files(manifests, router)
    assert "/etc/prometheus/prometheus.yml" in mounted_files(manifests, pods(manifests)["prometheus"])


def test_every_secret_and_configuration_is_used_and_every_volume_exists(manifests: list[Manifest]) -> None:
    used: set[str] = set()
    claims: set[str] = set()
    for owner in (of_kind(manifests, "StatefulSet") | of_kind(manifests, "Job")).values():
        pod = owner["spec"]["template"]
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        templates = {claim["metadata"]["name"] for claim in owner["spec"].get("volumeClaimTemplates", [])}
        assert {mount["name"] for mount in container(pod)["volumeMounts"]} == volumes.keys() | templates
        used |= {volume["secret"]["secretName"] for volume in volumes.values() if "secret" in volume}
        used |= {volume["configMap"]["name"] for volume in volumes.values() if "configMap" in volume}
        used |= {source["configMapRef"]["name"] for source in container(pod).get("envFrom", [])}
        claims |= {v["persistentVolumeClaim"]["claimName"] for v in volumes.values() if "persistentVolumeClaim" in v}
    assert used == of_kind(manifests, "Secret").keys() | of_kind(manifests, "ConfigMap").keys()
    assert claims == of_kind(manifests, "PersistentVolumeClaim").keys()


def test_a_role_s_certificate_is_mounted_by_its_pods_only(manifests: list[Manifest]) -> None:
    roles = {"sim-worker": "worker", "prometheus": "viewer"}
    for name, pod in pods(manifests).items():
        secrets = [volume["secret"]["secretName"] for volume in pod["spec"]["volumes"] if "secret" in volume]
        assert [secret.rsplit("-", 1)[0] for secret in secrets] == [f"certificates-{roles.get(name, name)}"]


def test_services_lead_to_ports_of_pods(manifests: list[Manifest]) -> None:
    services = of_kind(manifests, "Service")
    for service in services.values():
        (pod,) = selected(manifests, service["spec"]["selector"])
        offered = {port["name"]: port["port"] for port in service["spec"]["ports"]}
        assert offered.items() <= ports(pods(manifests)[pod]).items()
    for name, owner in of_kind(manifests, "StatefulSet").items():
        assert selected(manifests, services[owner["spec"]["serviceName"]]["spec"]["selector"]) == [name]
        assert (
            owner["spec"]["selector"]["matchLabels"].items() <= owner["spec"]["template"]["metadata"]["labels"].items()
        )


def test_services_listen_where_ports_say(manifests: list[Manifest]) -> None:
    for name, pod in pods(manifests).items():
        listen = {value for key, value in environment(manifests, pod).items() if key.endswith("_LISTEN")}
        if listen:
            assert listen == {f"0.0.0.0:{port}" for port in ports(pod).values()}, name
    connect = environment(manifests, pods(manifests)["planner"])["CPN_CONNECT"]
    (port,) = of_kind(manifests, "Service")["router"]["spec"]["ports"]
    assert connect == f"tls/router:{port['port']}"


def test_probes_ask_as_compose_does(manifests: list[Manifest], compose: Manifest) -> None:
    for name, pod in pods(manifests).items():
        probes = [value for key, value in container(pod).items() if key.endswith("Probe")]
        assert len(probes) == {"planner": 3, "trainer": 3, "router": 2, "prometheus": 2, "sim-worker": 1}.get(name, 0)
        for probe in probes:
            if "httpGet" in probe:
                assert probe["httpGet"]["port"] in ports(pod)
                continue
            kind, *command = compose[SERVICES[name]]["healthcheck"]["test"]
            if kind == "CMD-SHELL":
                command = ["/bin/sh", "-c", command[0].replace("$$HOSTNAME", "$POD_NAME")]
            assert probe["exec"]["command"] == command


def test_pods_have_no_privileges(manifests: list[Manifest]) -> None:
    (namespace,) = of_kind(manifests, "Namespace").values()
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"
    (report,) = read(KUBERNETES / "report.yaml")
    for pod in [*pods(manifests).values(), report]:
        spec = pod["spec"]
        assert spec["securityContext"] == {
            "runAsNonRoot": True,
            "runAsUser": 10001,
            "runAsGroup": 10001,
            "fsGroup": 10001,
            "fsGroupChangePolicy": "OnRootMismatch",
            "seccompProfile": {"type": "RuntimeDefault"},
        }
        assert container(pod)["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert spec["automountServiceAccountToken"] is False
        # A service named cpn-planner would set CPN_PLANNER_PORT, which a planner refuses.
        assert spec["enableServiceLinks"] is False
    for pod in pods(manifests).values():
        assert {"name": "tmp", "mountPath": "/tmp"} in container(pod)["volumeMounts"]  # noqa: S108
    (volume,) = report["spec"]["volumes"]
    assert volume["persistentVolumeClaim"]["claimName"] in of_kind(manifests, "PersistentVolumeClaim")
    assert report["metadata"]["namespace"] in of_kind(manifests, "Namespace")


def test_the_evaluator_knows_every_planner_and_worker(manifests: list[Manifest], compose: Manifest) -> None:
    (autoscaler,) = of_kind(manifests, "HorizontalPodAutoscaler").values()
    assert autoscaler["spec"]["scaleTargetRef"] == {"apiVersion": "apps/v1", "kind": "StatefulSet", "name": "planner"}
    jobs = of_kind(manifests, "Job")
    workers = jobs["sim-worker"]["spec"]
    assert workers["completions"] == workers["parallelism"]
    planners = [f"planner-{number}" for number in range(autoscaler["spec"]["maxReplicas"])]
    own = {f"--planner={','.join(planners)}", f"--workers={workers['parallelism']}", "--wait-secs=600"}
    arguments = container(jobs["evaluator"]["spec"]["template"])["args"]
    assert own <= set(arguments)
    options = {"--planner", "--workers", "--wait-secs"}
    expected = [a for a in compose["evaluator"]["command"] if a.split("=")[0] not in options]
    assert [argument for argument in arguments if argument not in own] == expected


def test_the_autoscaler_s_metric_is_the_planners(manifests: list[Manifest]) -> None:
    (autoscaler,) = of_kind(manifests, "HorizontalPodAutoscaler").values()
    (metric,) = autoscaler["spec"]["metrics"]
    name = metric["external"]["metric"]["name"]
    (adapter,) = read(KUBERNETES / "prometheus-adapter.yaml")
    assert [rule["seriesQuery"] for rule in adapter["rules"]["external"]] == [name]
    assert f'"{name}"' in (ROOT / "services/planner/src/load.rs").read_text()
    namespace = of_kind(manifests, "Namespace").popitem()[0]
    assert adapter["prometheus"]["url"] == f"http://prometheus.{namespace}.svc"
    assert [adapter["prometheus"]["port"]] == list(ports(pods(manifests)["prometheus"]).values())


def test_prometheus_scrapes_as_that_of_compose_does(manifests: list[Manifest]) -> None:
    def without_targets(path: Path) -> Manifest:
        (config,) = read(path)
        for job in config["scrape_configs"]:
            if job["job_name"] != "prometheus":
                for key in ("dns_sd_configs", "static_configs"):
                    job.pop(key, None)
                job["tls_config"].pop("server_name", None)
        return config

    own = KUBERNETES / "prometheus.yml"
    assert without_targets(own) == without_targets(ROOT / "deploy/prometheus/prometheus.yml")
    services = of_kind(manifests, "Service")
    for job in read(own)[0]["scrape_configs"][:2]:
        ((query,),) = [found["names"] for found in job["dns_sd_configs"]]
        port, protocol, service = query.split(".")
        assert protocol == "_tcp"
        assert port.removeprefix("_") in {port["name"] for port in services[service]["spec"]["ports"]}
        # Every certificate has its role's name.
        assert selected(manifests, services[service]["spec"]["selector"]) == [job["tls_config"]["server_name"]]


def rules(policies: dict[str, Manifest], direction: str, peers: str) -> Iterator[tuple[dict[str, str], Any, Any]]:
    for policy in policies.values():
        for rule in policy["spec"].get(direction, []):
            for peer in rule[peers]:
                for port in rule["ports"]:
                    yield policy["spec"]["podSelector"].get("matchLabels", {}), peer, port["port"]


def test_network_policies_let_through_what_is_needed_and_no_more(manifests: list[Manifest]) -> None:
    policies = of_kind(manifests, "NetworkPolicy")
    assert policies["default-deny"]["spec"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}

    def matching(peer: Manifest) -> list[str]:
        if "namespaceSelector" in peer:
            labels = peer.get("podSelector", peer["namespaceSelector"])["matchLabels"]
            return [f"{label}={value}" for label, value in labels.items()]
        return selected(manifests, peer["podSelector"]["matchLabels"])

    leaving = {
        (source, target, port)
        for labels, peer, port in rules(policies, "egress", "to")
        for source in selected(manifests, labels)
        for target in matching(peer)
    }
    entering = {
        (source, target, port)
        for labels, peer, port in rules(policies, "ingress", "from")
        for target in selected(manifests, labels)
        for source in matching(peer)
    }
    needed = {(name, "router", 7447) for name in SERVICES}
    needed |= {("prometheus", "planner", 9465), ("prometheus", "trainer", 9464)}
    assert leaving == needed | {(name, "kubernetes.io/metadata.name=kube-system", 53) for name in SERVICES}
    for_clients = {("router", 7447), ("planner", 50051), ("planner", 8000), ("trainer", 50052)}
    from_outside = {("cpn-client=true", target, port) for target, port in for_clients}
    from_outside |= {("app.kubernetes.io/name=prometheus-adapter", "prometheus", 9090)}
    assert entering == needed | from_outside
    for _, target, port in entering:
        assert port in ports(pods(manifests)[target]).values()
