"""The manifest for workers in Kubernetes, checked by the schemas of its API, and by what is expected of ours."""

import kubernetes_validate
import pytest
import yaml

from tests.docker.files import WORKERS, read_compose, read_image

# The first whose indexed Jobs count failures by index without a feature gate, and the newest with schemas.
VERSIONS = ("1.33", "1.37")


@pytest.fixture(scope="module")
def objects():
    return {each["kind"]: each for each in yaml.safe_load_all(WORKERS.read_text())}


@pytest.fixture(scope="module")
def job(objects):
    return objects["Job"]["spec"]


@pytest.fixture(scope="module")
def pod(job):
    return job["template"]["spec"]


@pytest.mark.parametrize("version", VERSIONS)
def test_manifest_is_by_the_schemas(objects, version):
    assert list(objects) == ["ConfigMap", "PersistentVolumeClaim", "Job"]
    for each in objects.values():
        assert kubernetes_validate.validate(each, version, strict=True) == version
    wrong = objects["Job"] | {"spec": objects["Job"]["spec"] | {"completionmode": "Indexed"}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, version, strict=True)


def test_job_is_indexed_and_repeats_only_what_may_help(job):
    assert (job["completionMode"], job["podReplacementPolicy"]) == ("Indexed", "Failed")
    assert job["completions"] == job["parallelism"] > 1
    assert job["backoffLimitPerIndex"] > 0
    taken_away, ended = job["podFailurePolicy"]["rules"]
    assert taken_away == {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]}
    # 0 is the end of the study, 2 and 75 may be a server that is unavailable, 130 a worker that was told to leave.
    assert (ended["action"], ended["onExitCodes"]) == ("FailIndex", {"operator": "In", "values": [1]})


def test_pod_does_not_run_as_root_and_fits_the_image(pod):
    # Required for counting failures by index.
    assert pod["restartPolicy"] == "Never"
    assert {"hostNetwork", "hostname"} & pod.keys() == set()
    user, group = map(int, read_image().words["USER"].split(":"))
    context = pod["securityContext"]
    assert context["runAsNonRoot"] is True
    assert (context["runAsUser"], context["runAsGroup"], context["fsGroup"]) == (user, group, group)
    (container,) = pod["containers"]
    assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    assert {"cpu", "memory"} <= container["resources"]["requests"].keys()
    assert "memory" in container["resources"]["limits"]
    assert pod["terminationGracePeriodSeconds"] >= 15


def test_pod_runs_what_a_worker_of_the_compose_file_runs(pod):
    (container,) = pod["containers"]
    # The image's entry point is kept.
    assert "command" not in container
    worker = read_compose()["services"]["worker"]
    assert container["args"] == worker["command"].split()
    targets = {volume.split(":")[1] for volume in worker["volumes"]} - {"/data"}
    assert {each["mountPath"] for each in container["volumeMounts"]} == targets


def test_pod_has_what_it_needs_and_no_password_in_the_text(objects, pod):
    (container,) = pod["containers"]
    (password,) = container["env"]
    assert password["name"] == "ARMSCAN_STORAGE_PASSWORD"
    assert password["valueFrom"]["secretKeyRef"].keys() == {"name", "key"}
    assert container["envFrom"] == [{"configMapRef": {"name": objects["ConfigMap"]["metadata"]["name"]}}]
    wanted = {key for key in read_compose()["services"]["worker"]["environment"] if not key.endswith("_FILE")}
    assert objects["ConfigMap"]["data"].keys() == wanted


def test_folder_is_shared_by_pods_on_several_nodes(objects, pod):
    claim = objects["PersistentVolumeClaim"]
    assert claim["spec"]["accessModes"] == ["ReadWriteMany"]
    by_name = {volume["name"]: volume for volume in pod["volumes"]}
    assert by_name["work"]["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
    (container,) = pod["containers"]
    assert {each["name"] for each in container["volumeMounts"]} == by_name.keys()
