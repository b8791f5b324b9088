"""Generator of the C++ code of an optimal control problem: constants and straight-line code for its exact sparsity.

Every formula is a CasADi expression, and `_emit` prints one lane operation for each of its instructions. Structural
zeros of the dynamics are never computed. The handwritten C++ source contains no numbers of the problem.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy

import casadi as ca
import numpy as np

from quad_swarm.planner.problem import OptimalControlProblem
from quad_swarm.quadrotor import N_INPUTS, N_STATES

_UNBOUNDED = 1e9  # on the side of a state that has one bound only (m or m/s)


def generate_model(problem: OptimalControlProblem) -> str:
    """Generate the header ``model.hpp``, which `kernel.cpp` includes.

    :param problem: the problem, whose class may be the user's
    :return: text of the header
    :raises ValueError: if the method cannot solve the problem
    """
    _check_form(problem)
    nx, nu, n_others = problem.nx, problem.nu, problem.n_others
    state, low, high = _state_bounds(problem)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    x_next = problem.dynamics(x, u)
    a_expression, b_expression = ca.jacobian(x_next, x), ca.jacobian(x_next, u)
    a, a_symbols, a_values = _varying("a", a_expression)
    b, b_symbols, b_values = _varying("b", b_expression)

    constants = {
        "N": problem.config.horizon,
        "NX": nx,
        "NU": nu,
        "N_OTHERS": n_others,
        "N_BOUNDS": len(state),
        "N_A": a_symbols.numel(),
        "N_B": b_symbols.numel(),
        "N_FACTOR": nu * (nu + 1) // 2,
        "N_SYMMETRIC": nx * (nx + 1) // 2,
    }
    lines = ["// Generated from the optimal control problem. Arrays hold one vector of lanes for each number.", ""]
    lines += [f"constexpr int {name} = {value};" for name, value in constants.items()]
    lines += [
        f"constexpr bool SHAPED = {str(problem.shaped).lower()};",
        f"constexpr bool COMMITTED = {str(problem.committed).lower()};",
        f"constexpr bool DISTURBED = {str(problem.disturbed).lower()};",
        f"constexpr double VIOLATION_WEIGHT = {problem.config.violation_weight!r};",
        _array("double", "MIN_INPUT", problem.min_input.full().ravel()),
        _array("double", "MAX_INPUT", problem.max_input.full().ravel()),
        _array("int", "BOUNDED_STATE", state),
        _array("double", "STATE_LOW", low),
        _array("double", "STATE_HIGH", high),
        "",
    ]

    functions = [
        _emit("dynamics", {"x": x, "u": u}, {"x_next": x_next}),
        _emit("linearise", {"x": x, "u": u}, {"x_next": x_next, "a": a_values, "b": b_values}),
        _emit("drift", {"disturbance": (push := ca.SX.sym("disturbance", 3))}, {"moved": problem.drift(push)}),
        *_costs(problem),
        *_riccati(problem, (a, a_symbols), (b, b_symbols)),
    ]
    return "\n".join(lines) + "\n" + "\n".join(functions)


def formulas(problem: OptimalControlProblem) -> tuple[object, ...]:
    """Return a key of everything that `generate_model` reads from a problem, in a few milliseconds."""
    x, u, x0 = ca.SX.sym("x", problem.nx), ca.SX.sym("u", problem.nu), ca.SX.sym("x0", problem.nx)
    goal, others, distance = ca.SX.sym("goal", 3), ca.SX.sym("others", 3, problem.n_others), ca.SX.sym("distance")
    outputs = [
        problem.dynamics(x, u),
        problem.input_cost(u),
        problem.goal_cost(x, x0, goal),
        ca.vertcat(*problem.distances(x, others)),
        problem.repulsion_residual(distance),
        problem.repulsion_cost(distance),
        problem.box_violations(x),
        problem.drift(goal),
    ]
    function = ca.Function("formulas", [x, u, x0, goal, others, distance], outputs)
    limits = (*problem.min_input.full().ravel(), *problem.max_input.full().ravel())
    sizes = problem.n_others, problem.shaped, problem.committed, problem.disturbed
    return problem.config, sizes, limits, function.serialize()


def _check_form(problem: OptimalControlProblem) -> None:
    """Refuse problems that `kernel.cpp` would solve only in part.

    :raises ValueError: if there are any
    """
    x, u, n_others = ca.SX.sym("x", problem.nx), ca.SX.sym("u", problem.nu), problem.n_others
    if not (1 <= problem.nx <= N_STATES and 1 <= problem.nu <= N_INPUTS):
        raise _beyond("nx and nu", f"must be at most {N_STATES} and {N_INPUTS}, not {problem.nx} and {problem.nu}")
    if ca.depends_on(ca.hessian(problem.input_cost(u), u)[0], u):
        raise _beyond("input_cost", "must be quadratic in the inputs")
    distance = ca.SX.sym("distance")
    squared = [problem.repulsion_cost(distance), problem.repulsion_residual(distance) ** 2]
    if not _agree([distance], squared[0], squared[1], scale=2 * problem.config.separation):
        raise _beyond("repulsion_cost", "must be the square of repulsion_residual: change that method instead")
    columns = [ca.SX.sym(f"other{j}", 3) for j in range(n_others)]
    distances = problem.distances(x, ca.horzcat(*columns)) if n_others else []
    if len(distances) != n_others:
        raise _beyond("distances", f"must be one for each of the {n_others} others, not {len(distances)}")
    for column, one in zip(columns, distances, strict=True):
        moved = ca.substitute(one, column, columns[0])
        rest = [other for other in columns if other is not column]
        if ca.depends_on(one, ca.vertcat(x[3:], *rest)) or not _agree([x, columns[0]], moved, distances[0], scale=2.0):
            raise _beyond("distances", "must depend on the two positions only, in the same way for each of the others")


def _agree(symbols: list[ca.SX], first: ca.SX, second: ca.SX, scale: float) -> bool:
    """Return whether two expressions have the same values, at points drawn from a normal distribution."""
    function = ca.Function("both", symbols, [first, second])
    rng = np.random.default_rng(0)
    for _ in range(16):
        one, other = (value.full() for value in function(*(np.abs(scale * rng.normal(size=s.shape)) for s in symbols)))
        if not np.allclose(one, other, rtol=1e-9, atol=1e-12, equal_nan=True):
            return False
    return True


def _beyond(what: str, rule: str) -> ValueError:
    return ValueError(f"The problem's {what} {rule}; solver='fatrop' solves it as it is.")


def _costs(problem: OptimalControlProblem) -> list[str]:
    nx, nu = problem.nx, problem.nu
    x, u, x0 = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("x0", nx)
    goal, other, distance = ca.SX.sym("goal", 3), ca.SX.sym("other", 3), ca.SX.sym("distance")
    hessian, gradient = ca.hessian(problem.goal_cost(x, x0, goal), x)
    # Gauss-Newton approximation of the repulsion r(d)^2: gradient 2 r r', curvature 2 r'^2
    residual = problem.repulsion_residual(distance)
    slope = ca.jacobian(residual, distance)
    # With nobody, the kernel does not call the function
    some = problem
    if not problem.n_others:
        some = copy(problem)
        some.n_others = 1
    columns = [other, *(ca.SX.sym(f"other{j}", 3) for j in range(1, some.n_others))]
    about_other = {"x": x, "other": other}
    if problem.shaped:
        about_other["shape"] = ca.SX.sym("shape", 3)
        shapes = ca.horzcat(*[about_other["shape"]] * some.n_others)
        separation = some.shaped_distances(x, ca.horzcat(*columns), shapes)[0]
    else:
        separation = some.distances(x, ca.horzcat(*columns))[0]
    return [
        _emit("input_gradient", {"u": u}, {"gradient": ca.gradient(problem.input_cost(u), u)}),
        _emit(
            "goal_derivatives",
            {"x": x, "x0": x0, "goal": goal},
            {"gradient": gradient, "hessian": _packed(hessian)},
        ),
        _emit(
            "separation",
            about_other,
            {
                "distance": separation,
                "gap": separation - problem.config.separation,
                "direction": ca.gradient(separation, x)[:3],
            },
        ),
        _emit("repulsion", {"distance": distance}, {"gradient": 2 * residual * slope, "curvature": 2 * slope * slope}),
    ]


def _riccati(
    problem: OptimalControlProblem, dynamics_a: tuple[ca.SX, ca.SX], dynamics_b: tuple[ca.SX, ca.SX]
) -> list[str]:
    """Return one stage of the Riccati recursion, with R + B'PB = L D L' and the gain K = -(R + B'PB)^-1 B'PA."""
    nx, nu = problem.nx, problem.nu
    (a, a_symbols), (b, b_symbols) = dynamics_a, dynamics_b
    u = ca.SX.sym("u", nu)
    p_symbols = ca.SX.sym("p", nx * (nx + 1) // 2)
    p = _unpacked(p_symbols, nx)
    weight = ca.SX.sym("weight", nu)
    pb = p @ b
    r = ca.hessian(problem.input_cost(u), u)[0] + ca.diag(weight) + b.T @ pb
    lower, inverse_d = _factorise(r)
    w = _forward_substitute(lower, pb.T @ a)
    dw = ca.diag(inverse_d) @ w
    gain = -_backward_substitute(lower, dw)
    p_previous = a.T @ (p @ a) - w.T @ dw
    factor = ca.vertcat(*[lower[i, j] for i in range(nu) for j in range(i)], inverse_d)

    factor_symbols = ca.SX.sym("factor", nu * (nu + 1) // 2)
    lower, inverse_d = _unpacked_factor(factor_symbols, nu)
    gain_symbols = ca.SX.sym("gain", nu, nx)
    costate, gradient = ca.SX.sym("costate", nx), ca.SX.sym("gradient", nu)
    total = gradient + b.T @ costate
    feedforward = -_backward_substitute(lower, inverse_d * _forward_substitute(lower, total))
    costate_previous = a.T @ costate + gain_symbols.T @ total
    dx = ca.SX.sym("dx", nx)
    feedforward_symbols = ca.SX.sym("feedforward", nu)
    du = feedforward_symbols + gain_symbols @ dx

    factor_inputs = {"p": p_symbols, "a": a_symbols, "b": b_symbols, "weight": weight}
    vector_inputs = {
        "costate": costate,
        "gradient": gradient,
        "a": a_symbols,
        "b": b_symbols,
        "factor": factor_symbols,
        "gain": gain_symbols,
    }
    # The state of stage 0 is given, so there is no gain and no earlier stage
    return [
        _emit("riccati", factor_inputs, {"factor": factor, "gain": gain, "p_previous": _packed(p_previous)}),
        _emit("riccati_first", {k: factor_inputs[k] for k in ("p", "b", "weight")}, {"factor": factor}),
        _emit("backward", vector_inputs, {"feedforward": feedforward, "costate_previous": costate_previous}),
        _emit(
            "backward_first",
            {k: vector_inputs[k] for k in ("costate", "gradient", "b", "factor")},
            {"feedforward": feedforward},
        ),
        _emit(
            "forward",
            {"dx": dx, "feedforward": feedforward_symbols, "gain": gain_symbols, "a": a_symbols, "b": b_symbols},
            {"du": du, "dx_next": a @ dx + b @ du},
        ),
        _emit("forward_first", {"du": feedforward_symbols, "b": b_symbols}, {"dx_next": b @ feedforward_symbols}),
    ]


def _state_bounds(problem: OptimalControlProblem) -> tuple[list[int], list[float], list[float]]:
    """Return the indices of bounded states, their lower and their upper bounds, from the rows of `box_violations`."""
    x = ca.SX.sym("x", problem.nx)
    rows = problem.box_violations(x)
    jacobian = ca.jacobian(rows, x)
    rule = "must be bounds: each row plus or minus one state, plus a constant, and at most two rows for a state"
    if not jacobian.is_constant():
        raise _beyond("box_violations", rule)
    slopes = ca.DM(jacobian).full()
    offsets = ca.Function("offsets", [x], [rows])(0).full().ravel()
    low: dict[int, float] = {}
    high: dict[int, float] = {}
    for slope, offset in zip(slopes, offsets, strict=True):
        bounded = np.flatnonzero(slope)
        index = int(bounded[0]) if len(bounded) == 1 else -1
        bounds = high if slope[index] > 0 else low
        # The kernel weights each violation alike, so a row in other units would weigh otherwise
        if len(bounded) != 1 or abs(slope[index]) != 1 or index in bounds or not np.isfinite(offset):
            raise _beyond("box_violations", rule)
        bounds[index] = float(-offset / slope[index])
    states = sorted({*low, *high})
    if not states:
        raise _beyond("box_violations", "must bound at least one state")
    return states, [low.get(i, -_UNBOUNDED) for i in states], [high.get(i, _UNBOUNDED) for i in states]


def _varying(name: str, matrix: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Replace the entries of a matrix that are not constant by symbols. Returns the matrix, the symbols and the
    expressions of these entries."""
    entries = matrix.nonzeros()
    values = [entry for entry in entries if not entry.is_constant()]
    symbols = ca.SX.sym(name, len(values))
    remaining = iter(symbols.nonzeros())
    mixed = [entry if entry.is_constant() else next(remaining) for entry in entries]
    return ca.SX(matrix.sparsity(), ca.vertcat(*mixed)), symbols, ca.vertcat(*values)


def _packed(symmetric: ca.SX) -> ca.SX:
    """Return the lower triangle row by row."""
    return ca.vertcat(*[symmetric[i, j] for i in range(symmetric.shape[0]) for j in range(i + 1)])


def _unpacked(packed: ca.SX, n: int) -> ca.SX:
    return ca.vertcat(
        *[ca.horzcat(*[packed[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)] for j in range(n)]) for i in range(n)]
    )


def _unpacked_factor(packed: ca.SX, n: int) -> tuple[ca.SX, ca.SX]:
    lower = ca.SX(n, n)
    for i in range(n):
        for j in range(i):
            lower[i, j] = packed[i * (i - 1) // 2 + j]
    return lower, packed[n * (n - 1) // 2 :]


def _factorise(matrix: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Factorise a positive definite matrix L D L'. Returns L (below its unit diagonal) and 1 / D."""
    n = matrix.shape[0]
    lower = ca.SX(n, n)
    d: list[ca.SX] = []
    inverse_d: list[ca.SX] = []
    for j in range(n):
        d.append(matrix[j, j] - sum((lower[j, k] * (lower[j, k] * d[k]) for k in range(j)), start=ca.SX(0)))
        inverse_d.append(1 / d[j])
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((lower[i, k] * (lower[j, k] * d[k]) for k in range(j)), start=ca.SX(0))
            lower[i, j] = rest * inverse_d[j]
    return lower, ca.vertcat(*inverse_d)


def _forward_substitute(lower: ca.SX, rhs: ca.SX) -> ca.SX:
    rows: list[ca.SX] = []
    for i in range(rhs.shape[0]):
        rows.append(rhs[i, :] - sum((lower[i, k] * rows[k] for k in range(i)), start=ca.SX.zeros(1, rhs.shape[1])))
    return ca.vertcat(*rows)


def _backward_substitute(lower: ca.SX, rhs: ca.SX) -> ca.SX:
    n = rhs.shape[0]
    rows: dict[int, ca.SX] = {}
    for i in reversed(range(n)):
        known = sum((lower[k, i] * rows[k] for k in range(i + 1, n)), start=ca.SX.zeros(1, rhs.shape[1]))
        rows[i] = rhs[i, :] - known
    return ca.vertcat(*[rows[i] for i in range(n)])


def _array(kind: str, name: str, values: Sequence[float]) -> str:
    convert = int if kind == "int" else float
    return f"constexpr {kind} {name}[] = {{{', '.join(repr(convert(value)) for value in values)}}};"


_UNARY = {
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "splat<V>(1) / {0}",
    ca.OP_SQRT: "square_root({0})",
    ca.OP_EXP: "exponential({0})",
    ca.OP_TAN: "tangent({0})",
    ca.OP_COS: "cosine({0})",
    ca.OP_ASSIGN: "{0}",
}
_BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_FMAX: "maximum({0}, {1})",
    ca.OP_FMIN: "minimum({0}, {1})",
}


def _emit(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> str:
    """Generate a C++ function of lanes that evaluates the outputs. Arrays hold each argument column by column.

    :param name: name of the C++ function
    :param inputs: argument names and their symbols
    :param outputs: argument names and their expressions
    """
    function = ca.Function(name, list(inputs.values()), ca.cse([ca.densify(value) for value in outputs.values()]))
    arguments = [f"const V* __restrict {argument}" for argument in inputs]
    arguments += [f"V* __restrict {argument}" for argument in outputs]
    body = _Walk(function, list(inputs), list(outputs)).lines()
    return f"template <class V>\ninline void {name}({', '.join(arguments)}) {{\n" + "".join(body) + "}\n"


class _Walk:
    """Instructions of a CasADi function in single-assignment form, with products fused into the sums that use them."""

    def __init__(self, function: ca.Function, inputs: list[str], outputs: list[str]):
        self._operation: list[int] = []
        self._operands: list[tuple[int, ...]] = []
        self._text: dict[int, str] = {}  # text of inputs and constants
        self._uses: list[int] = []
        self._constants: dict[int, float] = {}
        self._stores: list[tuple[str, int]] = []
        at: dict[int, int] = {}  # slot of CasADi's work vector -> its current value
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            read, written = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_OUTPUT:
                self._uses[at[read[0]]] += 1
                self._stores.append((f"{outputs[written[0]]}[{written[1]}]", at[read[0]]))
                continue
            if operation == ca.OP_INPUT:
                at[written[0]] = self._append(operation, text=f"{inputs[read[0]]}[{read[1]}]")
            elif operation == ca.OP_CONST:
                at[written[0]] = self._constant(float(function.instruction_constant(k)))
            else:
                operands = tuple(at[slot] for slot in read)
                if operation == ca.OP_DIV and operands[1] in self._constants:  # products are cheaper
                    operation, operands = ca.OP_MUL, (operands[0], self._constant(1 / self._constants[operands[1]]))
                at[written[0]] = self._append(operation, operands)

    def _append(self, operation: int, operands: tuple[int, ...] = (), text: str | None = None) -> int:
        value = len(self._operation)
        for operand in operands:
            self._uses[operand] += 1
        self._operation.append(operation)
        self._operands.append(operands)
        self._uses.append(0)
        if text is not None:
            self._text[value] = text
        return value

    def _constant(self, number: float) -> int:
        value = self._append(ca.OP_CONST, text=f"splat<V>({number!r})")
        self._constants[value] = number
        return value

    def lines(self) -> list[str]:
        """Return the statements of the C++ function's body."""
        fused: dict[int, str] = {}
        hidden: set[int] = set()
        for value, operation in enumerate(self._operation):
            if operation in (ca.OP_ADD, ca.OP_SUB):
                first, second = self._operands[value]
                if self._is_product(second) and second not in hidden:
                    form = "multiply_add" if operation == ca.OP_ADD else "negative_multiply_add"
                    fused[value] = f"{form}({self._factors(second)}, {self._name(first)})"
                    hidden.add(second)
                elif self._is_product(first) and first not in hidden:
                    form = "multiply_add" if operation == ca.OP_ADD else "multiply_subtract"
                    fused[value] = f"{form}({self._factors(first)}, {self._name(second)})"
                    hidden.add(first)
        body = []
        for value, operation in enumerate(self._operation):
            if value in self._text or value in hidden:
                continue
            names = [self._name(operand) for operand in self._operands[value]]
            if value in fused:
                text = fused[value]
            elif operation in _UNARY:
                text = _UNARY[operation].format(*names)
            elif operation in _BINARY:
                text = _BINARY[operation].format(*names)
            else:
                raise ValueError(
                    f"CasADi's operation {operation} has no lane form: add it to the tables in {__name__}, or choose "
                    "solver='fatrop'."
                )
            body.append(f"  const V {self._name(value)} = {text};\n")
        return body + [f"  {target} = {self._name(value)};\n" for target, value in self._stores]

    def _is_product(self, value: int) -> bool:
        return self._operation[value] in (ca.OP_MUL, ca.OP_SQ) and self._uses[value] == 1

    def _factors(self, product: int) -> str:
        names = [self._name(operand) for operand in self._operands[product]]
        return f"{names[0]}, {names[-1]}"

    def _name(self, value: int) -> str:
        return self._text.get(value, f"t{value}")
