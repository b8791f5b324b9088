"""The pages of the site: examples run, links lead somewhere, tables of arguments are those of the code."""

import inspect
import json
import re
import runpy
from pathlib import Path

import gymnasium
import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

# Registered before the first page, so that they stay so after it
import quad_swarm
import sb3_maddpg.team.toys  # noqa: F401
from quad_swarm.evaluation.rows import read_rows
from quad_swarm.task.rules import RULES
from sb3_maddpg import MADDPG, MATD3, MADDPGPolicy, PairPolicy
from sb3_maddpg.cli.main import COMMANDS
from sb3_maddpg.common.estimators import ESTIMATORS

ROOT = Path(__file__).parents[2]
TRIED = "benchmarks/results/action_spaces.json"
LEARNER = ("maddpg", "matd3", "pettingzoo", "relational", "migration", "support", "integrations")
SITE = (
    "quickstart",
    "team_environments",
    "tensorboard",
    "resuming",
    "clusters",
    "tutorials/swarm",
    "tutorials/pettingzoo",
)
NO_LEARNING = (
    "tutorials/scenario",
    "tutorials/rule",
    "tutorials/reading",
    "planner",
    "obstacles",
    "index",
    "faq",
    "files",
    "autopilots",
    "robots",
)
PAGES = ("README.md", "CONTRIBUTING.md", *(f"docs/{name}.md" for name in (*LEARNER, *SITE, *NO_LEARNING)))
STEPS, LEARNING_STARTS, BATCH_SIZE = 300, 100, 64
FENCED = re.compile(r"^```(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)  # also ```{eval-rst}


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def examples(page: str) -> list[tuple[int, str]]:
    """:return: the line on which each Python example begins, counted from 0, and the example"""
    text = text_of(page)
    blocks = [block for block in FENCED.finditer(text) if block[1] == "python"]
    return [(text[: block.start(2)].count("\n"), block[2]) for block in blocks]


def test_the_reference_of_the_command_line_has_all_commands():
    parsers = re.findall(r"^:func: (.*)$", text_of("docs/cli.md"), re.MULTILINE)
    assert sorted(parsers) == sorted([*COMMANDS, "evaluate_elsewhere"])
    for name, command in COMMANDS.items():
        assert f"| [`{name}`](#{name}) | {command.help} |" in text_of("docs/cli.md")
    functions = runpy.run_path(str(ROOT / "docs/commands.py"))
    for name in COMMANDS:
        assert functions[name]().prog == f"sb3-maddpg {name}"


@pytest.fixture
def short_trainings(monkeypatch, tmp_path):
    """An empty folder to work in, where ``learn`` soon begins and soon ends."""
    learn = OffPolicyAlgorithm.learn
    registries = (gymnasium.registry, quad_swarm.SCENARIOS, RULES)
    known = [dict(registry) for registry in registries]

    def learn_a_little(self, total_timesteps, *args, **kwargs):
        self.learning_starts = min(self.learning_starts, LEARNING_STARTS)
        self.batch_size = min(self.batch_size, BATCH_SIZE)
        return learn(self, min(total_timesteps, STEPS), *args, **kwargs)

    monkeypatch.setattr(OffPolicyAlgorithm, "learn", learn_a_little)
    monkeypatch.chdir(tmp_path)
    yield
    for registry, entries in zip(registries, known, strict=True):
        registry.clear()
        registry.update(entries)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if examples(page)])
def test_examples_run(page, short_trainings):
    namespace = {"__name__": "__main__"}
    for line, code in examples(page):
        exec(compile("\n" * line + code, ROOT / page, "exec"), namespace)
    models = [value for value in namespace.values() if isinstance(value, OffPolicyAlgorithm)]
    assert all(model._n_updates > 0 for model in models if model.num_timesteps)
    assert models or page.removeprefix("docs/").removesuffix(".md") in NO_LEARNING


def anchors(page: Path) -> set[str]:
    """:return: what GitHub makes of the headings"""
    prose = FENCED.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ +(.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


FOLDERS = ("benchmarks", "docs", "envs", "examples", "sb3_maddpg", "studies", "tests", "zoo_configs")
EVERY_PAGE = sorted(
    path.relative_to(ROOT).as_posix()
    for folder in FOLDERS
    for path in (*(ROOT / folder).rglob("*.md"), *(ROOT / folder).rglob("*.ipynb"))
    if not {"_build", ".ipynb_checkpoints"} & set(path.parts)
) + [path.name for path in ROOT.glob("*.md")]


def prose(page: str) -> str:
    """:return: a page, or a notebook's cells of text, without fenced code"""
    text = text_of(page)
    if page.endswith(".ipynb"):
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return FENCED.sub("", text)


@pytest.mark.parametrize("page", EVERY_PAGE)
def test_links_and_pictures_lead_somewhere(page):
    text = prose(page)
    named = dict(re.findall(r"^\[([^\]]+)\]: *(\S+)", text, re.MULTILINE))
    used = re.findall(r"\]\[([^\]]+)\]", text)
    assert set(used) <= set(named), "links by names that are given nowhere"
    inline = re.findall(r"\]\(<?([^)\s>]+)>?(?: +\"[^\"]*\")?\)", text)
    html = re.findall(r"<(?:a|img|source)\b[^>]*?(?:href|src|srcset)=\"([^\"]+)\"", text)
    for link in (*inline, *named.values(), *html):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        assert not anchor or target.suffix != ".md" or anchor in anchors(target), link


NOT_FILES = {"quad_swarm/parallel_env"}  # an environment's id


@pytest.mark.parametrize("page", EVERY_PAGE)
def test_files_that_are_named_exist(page):
    """From the project's folder, the page's, or `envs` for `quad_swarm/...`; the changelog names older ones too."""
    code = re.findall(r"`([^`\n]+)`", prose(page))
    for path in (path for one in code for path in re.findall(r"(?<![\w./:-])[\w.-]+(?:/[\w.-]+)+", one)):
        placeholder = re.search(r"\b[A-Z]{3,}\b|_build", path.removesuffix("README.md"))
        if path.split("/")[0] not in (*FOLDERS, "quad_swarm") or placeholder or path in NOT_FILES:
            continue
        found = any((base / path).exists() for base in (ROOT, ROOT / "envs", (ROOT / page).parent))
        assert found or page == "CHANGELOG.md", path
    for module in re.findall(r"python -m ((?:studies|benchmarks)(?:\.\w+)+)", text_of(page)):
        path = module.replace(".", "/")
        assert any((ROOT / f"{path}{end}").exists() for end in (".py", "")) or module.endswith("NAME"), module


def table(page: str, heading: str) -> dict[str, str]:
    """:return: the first two columns of the first table below a heading, of rows that begin with a name"""
    text = text_of(page).split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `([^`]+)` \| *(?:`([^`]+)`)?[^|]*\|", text, re.MULTILINE)
    return dict(rows)


def shown(default) -> str:
    if default is inspect.Parameter.empty:
        return ""
    if isinstance(default, type):
        return default.__name__
    text = f'"{default}"' if isinstance(default, str) else repr(default)
    return f"{default:_}" if type(default) is int and default > 9999 else text


def arguments(function, *left_out: str) -> dict[str, str]:
    parameters = inspect.signature(function).parameters.values()
    kinds = {one.name: shown(one.default) for one in parameters if one.kind is not inspect.Parameter.VAR_KEYWORD}
    return {name: value for name, value in kinds.items() if name not in ("self", "_init_setup_model", *left_out)}


# `policy_kwargs` have another default inside
SAME_AS_MADDPG = {name for name, _ in arguments(MADDPG.__init__).items() & arguments(MATD3.__init__).items()} - {
    "policy_kwargs"
}


@pytest.mark.parametrize(
    ("page", "heading", "expected"),
    [
        ("docs/maddpg.md", "Parameters", arguments(MADDPG.__init__)),
        # Those that differ from MADDPG's
        ("docs/matd3.md", "Parameters", arguments(MATD3.__init__, *SAME_AS_MADDPG)),
        *(
            (page, heading, arguments(policy.__init__, "observation_space", "action_space", "lr_schedule"))
            for page, heading, policy in (
                ("docs/maddpg.md", "Policies", MADDPGPolicy),
                ("docs/relational.md", "Parameters", PairPolicy),
            )
        ),
    ],
)
def test_tables_of_arguments_are_those_of_the_code(page, heading, expected):
    assert table(page, heading) == expected
    assert list(table(page, heading)) == list(expected)


def test_every_estimator_is_described():
    described = table("docs/maddpg.md", "How agents act and explore")
    assert [name for name in described if name in ESTIMATORS] == list(ESTIMATORS)


def test_a_duration_is_the_same_on_every_page():
    """Those of `python -m studies.swarm.training_time` and `python benchmarks/checkpoints.py --whole`."""
    runs = read_rows(ROOT / "studies/swarm/data/training.json.gz")
    (paper,) = (run["seconds"] / 60 for run in runs if run["recipe"] == "zoo_configs/quad_swarm_paper.yml")
    whole = json.loads(text_of("benchmarks/results/checkpoints.json"))
    (flight,) = (run["seconds"] / 60 for run in whole if run["whole"])
    for page in ("README.md", "docs/tutorials/swarm.md", "docs/notebooks/quickstart.ipynb", "examples/train_swarm.py"):
        assert f"{paper:.1f} minutes on one core" in text_of(page), page
    for page in ("README.md", "docs/flight_policies.md"):
        assert f"{flight:.0f} minutes on one core" in text_of(page), page
    assert f"whole training, {flight:.0f} minutes" in text_of("docs/resuming.md")


def test_the_code_of_the_readme_fits_github():
    """GitHub cuts off what is longer, without a hint."""
    lines = [line for block in FENCED.finditer(text_of("README.md")) for line in block[2].splitlines()]
    assert len(lines) > 20
    assert max(map(len, lines)) <= 92


def test_the_table_of_libraries_is_what_was_tried():
    lines = text_of("docs/migration.md").splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    titles = next(row for row in rows if "AgileRL 2.58" in row)
    cells = {row[0]: dict(zip(titles, row[1:], strict=True)) for row in rows if len(row) == len(titles) + 1}
    tried = {(row["library"], row["actions"]): row["trains"] for row in json.loads(text_of(TRIED))}
    asked = {
        "`Box` / `Discrete` actions": ("Box", "Discrete"),
        "`MultiDiscrete` / `MultiBinary`": ("MultiDiscrete", "MultiBinary"),
        "lengths that differ within a team, `Box` / `Discrete`": ("Box(3) and Box(5)", "Discrete(3) and Discrete(5)"),
        "`Box` beside `Discrete` in a team": ("Box and Discrete",),
    }
    libraries = {"here": "ours", "AgileRL 2.58": "agilerl", "BenchMARL 1.5.2": "benchmarl", "XuanCe 1.4.4": "xuance"}
    for row, actions in asked.items():
        for title, library in libraries.items():
            answers = ["yes" if tried[library, one] == "yes" else "no" for one in actions]
            assert cells[row][title] == " / ".join(answers), (row, title)
