"""What is uploaded to the Hugging Face Hub, and how; nothing here reaches a network."""

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import IDDPG, MADDPG, SafeVecNormalize, TeamEnv
from sb3_maddpg.cli.main import main
from sb3_maddpg.files.model_files import refuse_pickled
from sb3_maddpg.hub import model_card as hub
from sb3_maddpg.hub.pretrained import pretrained_folder
from sb3_maddpg.team.pettingzoo import make
from toys import SMALL


class RecordedApi:
    """In the place of the Hub's interface: keeps what it is given."""

    calls: list = []  # noqa: RUF012

    def __init__(self, token=None):
        self.calls.append(("token", token))

    def create_repo(self, repo_id, **kwargs):
        self.calls.append(("create", repo_id, kwargs))

    def upload_folder(self, folder_path, repo_id, commit_message):
        self.calls.append(("upload", repo_id, {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}))


@pytest.fixture
def api(monkeypatch):
    huggingface_hub = pytest.importorskip("huggingface_hub")
    RecordedApi.calls = []
    monkeypatch.setattr(huggingface_hub, "HfApi", RecordedApi)
    return RecordedApi


@pytest.fixture(scope="module")
def model():
    return MADDPG("MlpPolicy", make("mpe2.simple_spread_v3", continuous_actions=True), **SMALL)


def header(card: str) -> dict:
    begin, text, _ = card.split("---\n", 2)
    assert begin == ""
    return yaml.safe_load(text)


def test_a_model_is_uploaded_with_its_card(api, model, tmp_path):
    np.savez(tmp_path / "evaluations.npz", results=np.array([[0.0, 1.0], [2.0, 4.0]]), timesteps=[1, 2])
    (tmp_path / "OwnBit-v0").mkdir()
    (tmp_path / "OwnBit-v0" / "config.yml").write_text("gamma: 0.9")
    address = hub.publish(model, "me/a-model", tmp_path, private=True, token="secret")
    assert address == "https://huggingface.co/me/a-model"
    token, create, upload = api.calls
    assert token == ("token", "secret")
    assert create == ("create", "me/a-model", {"private": True, "exist_ok": True})
    files = upload[2]
    assert set(files) == {"model.zip", "README.md", "config.yml", "evaluations.npz"}
    assert files["config.yml"] == b"gamma: 0.9"
    card = files["README.md"].decode()
    (results,) = header(card)["model-index"]
    assert results["results"][0]["metrics"][0]["value"] == "3.00 +/- 1.00"
    assert "secret" not in card


def test_the_file_runs_no_code_and_the_card_says_how_to_load_it(model, tmp_path, monkeypatch):
    hub.write_model_folder(model, tmp_path / "out", "me/a-model")
    refuse_pickled(tmp_path / "out" / "model.zip", {})
    with zipfile.ZipFile(tmp_path / "out" / "model.zip") as archive:
        assert not [name for name in archive.namelist() if "optimizer" in name]
    card = (tmp_path / "out" / "README.md").read_text()
    assert "model-index" not in header(card)
    assert {"MADDPG", "multi-agent"} <= set(header(card)["tags"])
    # The lines of the card, with a download that finds the file here
    huggingface_hub = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda repo, name: str(tmp_path / "out" / name))
    (code,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    scope: dict = {}
    exec(code, scope)
    obs = np.zeros(model.observation_space.shape, np.float32)
    assert np.array_equal(scope["model"].predict(obs)[0], model.predict(obs)[0])


def test_the_card_tells_the_arguments_of_the_environment(tmp_path):
    assert main(["publish", "pretrained:quad-swarm-paper", "me/paper", "--out", str(tmp_path / "out")]) == 0
    card = (tmp_path / "out" / "README.md").read_text()
    assert "# MADDPG on QuadSwarm-v0" in card
    (arguments,) = re.findall(r"```yaml\n(.*?)```", card, re.DOTALL)
    assert yaml.safe_load(arguments)["observation"] == "state+approach+memory+plan+critic"
    folder = pretrained_folder("quad-swarm-paper")
    assert (tmp_path / "out" / "config.yml").read_bytes() == (folder / "config.yml").read_bytes()
    assert MADDPG.load(tmp_path / "out" / "model.zip").env_spec["id"] == "QuadSwarm-v0"


def test_a_whole_model_can_be_trained_on(api, tmp_path):
    model = IDDPG("MlpPolicy", make("mpe2.simple_spread_v3"), **SMALL)
    model.save(tmp_path / "model.zip")
    assert main(["publish", "--algo", "iddpg", "--whole", str(tmp_path / "model.zip"), "me/a-model"]) == 0
    (tmp_path / "again.zip").write_bytes(api.calls[-1][2]["model.zip"])
    assert IDDPG.load(tmp_path / "again.zip").lean is None


def test_a_hub_that_cannot_be_reached_is_one_line(api, model, tmp_path, monkeypatch, capsys):
    class UnreachableError(Exception):
        """Of an HTTP library, none of Python's own errors."""

    def unreachable(self, repo_id, **kwargs):
        raise UnreachableError("Name or service\nnot known")

    monkeypatch.setattr(api, "create_repo", unreachable)
    message = r"me/a-model could not be uploaded \(UnreachableError: Name or service not known\)\. Check the network"
    with pytest.raises(OSError, match=message):
        hub.publish(model, "me/a-model")
    model.save(tmp_path / "model.zip")
    assert main(["publish", str(tmp_path / "model.zip"), "me/a-model"]) == 1
    assert re.match(f"error: {message}.*--out DIR.*\n$", capsys.readouterr().err)


@pytest.mark.parametrize("name", ["model", "a/b/c", "/model", "me/", 3])
def test_another_name_is_refused(api, model, name):
    with pytest.raises(ValueError, match="must be NAME/REPOSITORY"):
        hub.publish(model, name)
    assert not api.calls


class Thousand(ParallelEnv):
    """Each of two agents observes 1000 +- 1 and says whether it is above 1000."""

    metadata = {"name": "thousand"}  # noqa: RUF012
    possible_agents = ("a", "b")

    def observation_space(self, agent):
        return spaces.Box(0, 2000, (1,))

    def action_space(self, agent):
        return spaces.Discrete(2)

    def look(self):
        self.above = dict(zip(self.possible_agents, self.rng.integers(2, size=2), strict=True))
        return {agent: np.float32([999 + 2 * above]) for agent, above in self.above.items()}

    def reset(self, seed=None, options=None):
        self.rng, self.agents, self.t = np.random.default_rng(seed), list(self.possible_agents), 0
        return self.look(), {}

    def step(self, actions):
        self.t += 1
        rewards = {agent: float(actions[agent] == self.above[agent]) for agent in self.agents}
        over = dict.fromkeys(self.agents, self.t == 10)
        if self.t == 10:
            self.agents = []
        return self.look(), rewards, dict.fromkeys(rewards, False), over, {}


@pytest.mark.slow
def test_a_model_of_normalised_observations_scores_as_its_card_says(tmp_path, monkeypatch):
    def make_env():
        return Monitor(TeamEnv(Thousand()))

    env = VecNormalize(DummyVecEnv([make_env]), norm_reward=False)
    arguments = {"gamma": 0.0, "learning_rate": 3e-3, "learning_starts": 200, "batch_size": 128, "train_freq": 2}
    model = MADDPG("MlpPolicy", env, **arguments, seed=0).learn(1500)
    hub.write_model_folder(model, tmp_path / "out", "me/a-model")
    huggingface_hub = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda repo, name: str(tmp_path / "out" / name))
    (code,) = re.findall(r"```python\n(.*?)```", (tmp_path / "out" / "README.md").read_text(), re.DOTALL)
    scope: dict = {"make_env": make_env}
    exec(code, scope)
    assert evaluate_policy(scope["model"], scope["env"], 10)[0] > 9.5, "10 at most, 5 by chance"


def test_a_model_without_its_statistics_is_not_published(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: TeamEnv(Thousand())]), norm_reward=False)
    model = MADDPG("MlpPolicy", env, **SMALL).learn(30)
    run = tmp_path / "run"
    (run / "ENV").mkdir(parents=True)
    model.save(run / "ENV.zip", exclude=["observation_statistics"])  # as earlier versions did
    with pytest.warns(UserWarning, match="normalised in the same way"):
        loaded = MADDPG.load(run / "ENV.zip")
    with pytest.raises(ValueError, match=r"neither its file nor a vecnormalize\.pkl of its run holds the statistics"):
        hub.write_model_folder(loaded, tmp_path / "out", "me/a-model", run)
    SafeVecNormalize.save(env, str(run / "ENV" / "vecnormalize.pkl"))
    hub.write_model_folder(loaded, tmp_path / "out", "me/a-model", run)
    with pytest.warns(UserWarning, match="normalised in the same way"):
        published = MADDPG.load(tmp_path / "out" / "model.zip")
    before, after = (one.agent_policy("a").predict(np.float32([1001])) for one in (model, published))
    assert before == after


def test_nothing_is_published_that_was_not_asked_for(model, tmp_path):
    run, out = tmp_path / "run", tmp_path / "out"
    (run / "service").mkdir(parents=True)
    (run / "service" / "config.yml").write_text("db_password: hunter2")
    (run / "notes").mkdir()
    (run / "notes" / "config.yml").write_text("gamma: [1")
    (tmp_path / "key").write_text("gamma: 0.1")
    (run / "linked").mkdir()
    (run / "linked" / "config.yml").symlink_to(tmp_path / "key")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "config.yml").write_text("gamma: 0.2")
    (run / "link").symlink_to(tmp_path / "elsewhere")
    (run / "evaluations.npz").symlink_to(tmp_path / "key")
    hub.write_model_folder(model, out, "me/a-model", run)
    assert {path.name for path in out.iterdir()} == {"model.zip", "README.md"}
    (run / "own").mkdir()
    (run / "own" / "config.yml").write_text("gamma: 0.3")
    hub.write_model_folder(model, out, "me/a-model", run)
    assert (out / "config.yml").read_text() == "gamma: 0.3"


@pytest.mark.parametrize("content", ["damaged", "large", "secret", "object"])
def test_evaluations_are_published_only_as_what_they_are(content, model, tmp_path):
    path = tmp_path / "evaluations.npz"
    if content == "damaged":
        path.write_bytes(b"PK\3\4 and no more")
    elif content == "large":  # compressed, a few kilobytes
        np.savez_compressed(path, results=np.zeros((3000, 1000)), timesteps=np.zeros(3000))
    elif content == "secret":
        np.savez(path, results=np.zeros((2, 2)), timesteps=np.zeros(2), password=np.array("hunter2"))
    else:
        np.savez(path, results=np.array([{}]), timesteps=np.zeros(1))
    hub.write_model_folder(model, tmp_path / "out", "me/a-model", tmp_path)
    assert (tmp_path / "out" / "evaluations.npz").exists() == (content == "object")
    assert "model-index" not in header((tmp_path / "out" / "README.md").read_text())
