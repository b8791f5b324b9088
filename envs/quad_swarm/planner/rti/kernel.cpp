// Batched real-time iteration: sequential quadratic programming on the optimal control problem of one robot, for many
// robots at once, one problem in each lane of a vector. docs/planner.md derives what is computed here.
//
// model.hpp is generated from the problem: its sizes, its bounds, and straight-line code for its derivatives and for
// one stage of the Riccati recursion. Nothing in this file knows a quadrotor.
//
// A lane that has converged, or whose numbers are no longer finite, is frozen by a select. No lane reads another.
#include <algorithm>
#include <numeric>
#include <vector>

#include "lanes.hpp"
#include "model.hpp"

namespace {

constexpr int STATE_STRIDE = 9;  // of the arrays that the caller passes; the problem may leave out trailing states
constexpr int INPUT_STRIDE = 4;

struct Options {
  std::int64_t max_iterations;  // of the interior-point method, for each quadratic program
  // On the mean complementarity, relative to 1 + COST_IN_TOLERANCE times the cost of violations. Where this cost is
  // large, single precision cannot reach a smaller complementarity, and nothing would be gained by it.
  double tolerance;
};

// The caller's arrays, all contiguous and of double precision.
struct Batch {
  const double* x;        // (count, 9)
  const double* goal;     // (count, 3)
  const double* others;   // (count, N_OTHERS, N, 3)
  const double* clearance;  // (count, N_OTHERS, N), or null
  const double* shape;    // (count, N_OTHERS, 3), or null
  const double* size;     // (count, N_OTHERS), or null
  const double* reference;         // (count, N, 3), or null
  const double* reference_weight;  // (count, N), or null
  const double* disturbance;       // (count, 3), or null
  const double* steady_input;      // (count, 4), or null
  double* x_plan;         // (count, N + 1, 9)
  double* u_plan;         // (count, N, 4)
  std::uint8_t* success;  // (count,)
  std::int64_t* iterations;  // (count,)
  std::uint8_t* moving;      // (count,) whether the last quadratic program still changed much
};

constexpr double START_COMPLEMENTARITY = 1.0;
constexpr double START_SLACK = 0.05;  // least t at the start, where the guess is nearer to the boundary or beyond it
constexpr double RESIDUAL_TOLERANCE = 2e-3;  // of the linear conditions, over their residual at the start
constexpr double COST_IN_TOLERANCE = 0.01;    // violations of metres cost thousands; see tolerance in Options
constexpr double STEP_TO_BOUNDARY = 0.99;
constexpr double STILL_MOVING = 0.3;  // change of an input over half of its range in the last quadratic program

// One inequality h + g z >= -s in the step z. A hard one has no violation s; a soft one pays rho s^2 / 2 for it, which
// makes s = lambda / rho and lets it be eliminated.
template <class V, bool SOFT>
struct Inequality {
  V value;              // h, at the point of linearisation
  V slack, multiplier;  // t, lambda > 0 with t = h + g z + lambda / rho at the solution
  V slack_step, multiplier_step;
  V offset;           // c in lambda = c - w (h + g z), the linearisation of t lambda = target
  V scaling;          // 1 / (t + lambda / rho)
  V inverse_product;  // 1 / (t lambda)

  void start(V h) {
    value = h;
    slack = maximum(h, splat<V>(START_SLACK));
    multiplier = splat<V>(START_COMPLEMENTARITY) / slack;
  }

  // y + lambda / rho
  static V relaxed(V y, V lambda) {
    if constexpr (SOFT) return multiply_add(splat<V>(0.5 / VIOLATION_WEIGHT), lambda, y);
    return y;
  }

  // w in lambda = c - w (h + g z)
  V weight() const { return multiplier * scaling; }

  // The force along g at z = 0.
  V force() const { return negative_multiply_add(weight(), value, offset); }

  // Make lambda a linear function of z, for the predictor's target 0. One division serves all that need one.
  void eliminate() {
    const V product = slack * multiplier;
    const V sum = relaxed(slack, multiplier);
    const V quotient = splat<V>(1) / (product * sum);
    inverse_product = quotient * sum;
    scaling = quotient * product;
    offset = product * scaling;
  }

  // The same for the corrector's target, and for the second-order term that the predictor's step left out.
  void correct(V target) {
    const V aim = negative_multiply_add(slack_step, multiplier_step, target);
    offset = multiply_add(slack, multiplier, aim) * scaling;
  }

  // The step of t and lambda that goes with h + g z = `reached`. It may be taken up to 1 / `overshoot`; `curvature`
  // sums the products of the two steps.
  void direct(V reached, V& overshoot, V& curvature) {
    const V new_multiplier = negative_multiply_add(weight(), reached, offset);
    slack_step = relaxed(reached, new_multiplier) - slack;
    multiplier_step = new_multiplier - multiplier;
    overshoot = maximum(overshoot, -slack_step * multiplier * inverse_product);
    overshoot = maximum(overshoot, -multiplier_step * slack * inverse_product);
    curvature = multiply_add(slack_step, multiplier_step, curvature);
  }

  // Take a part of the step; add the complementarity reached and the cost of the violation.
  void advance(V part, V& complementarity, V& cost) {
    slack = multiply_add(part, slack_step, slack);
    multiplier = multiply_add(part, multiplier_step, multiplier);
    complementarity = multiply_add(slack, multiplier, complementarity);
    if constexpr (SOFT) cost = multiply_add(multiplier * splat<V>(0.25 / VIOLATION_WEIGHT), multiplier, cost);
  }
};

// Stage k: the input u_k and the state x_{k+1} that it leads to.
template <class V>
struct Stage {
  V u[NU], x[NX];
  V a[N_A], b[N_B];  // entries of dx_{k+1}/dx_k and dx_{k+1}/du_k that are not constant
  V input_gradient[NU];
  V others[N_OTHERS][3];
  V clearance[N_OTHERS];     // distance to keep in addition to the separation
  V direction[N_OTHERS][3];  // from each other robot to this one
  V repulsion_gradient[N_OTHERS], repulsion_curvature[N_OTHERS];
  V reference[COMMITTED ? 3 : 0], reference_weight[COMMITTED ? 1 : 0];  // twice the weight
  V bound_sign[N_BOUNDS];
  Inequality<V, false> input_low[NU], input_high[NU];
  Inequality<V, true> bound[N_BOUNDS], separation[N_OTHERS];
  V factor[N_FACTOR], gain[NU * NX], feedforward[NU];  // of the Riccati recursion
  V du[NU];      // step of the input so far
  V new_du[NU];  // step of the input that the interior-point iteration proposes
};

constexpr double INEQUALITIES = N * (2.0 * NU + N_BOUNDS + N_OTHERS);

constexpr int packed(int i, int j) { return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i; }

template <class T, int W>
class LaneGroup {
 public:
  using V = typename LaneTypes<T, W>::Real;
  using Mask = MaskOf<V>;

  // A group of at most W problems of the batch. Unused lanes repeat the last problem.
  void solve(const Batch& batch, const double* u_guess, const std::int64_t* problems, int count, std::int64_t rounds,
             const Options& options) {
    load(batch, u_guess, problems, count);
    iterations_ = Mask{};
    for (std::int64_t k = 0; k < rounds; k++) {
      linearise();
      solve_quadratic_program(options);
      take_step();
    }
    store(batch, problems, count);
  }

 private:
  Stage<V> stages_[N];
  V x0_[NX], goal_[3];
  V shape_[SHAPED ? N_OTHERS : 0][3], size_[SHAPED ? N_OTHERS : 0];
  V goal_gradient_[NX], goal_hessian_[N_SYMMETRIC];
  V moved_[DISTURBED ? NX : 0], steady_input_[DISTURBED ? NU : 0];
  Mask iterations_, converged_, moving_;

  void load(const Batch& batch, const double* u_guess, const std::int64_t* problems, int count) {
    for (int q = 0; q < W; q++) {
      const std::int64_t problem = problems[q < count ? q : count - 1];
      for (int i = 0; i < NX; i++) x0_[i][q] = static_cast<T>(batch.x[problem * STATE_STRIDE + i]);
      for (int i = 0; i < 3; i++) goal_[i][q] = static_cast<T>(batch.goal[problem * 3 + i]);
      const double* u = u_guess + problem * N * INPUT_STRIDE;
      const double* others = batch.others + problem * N_OTHERS * N * 3;
      for (int k = 0; k < N; k++) {
        Stage<V>& s = stages_[k];
        for (int i = 0; i < NU; i++) s.u[i][q] = static_cast<T>(u[k * INPUT_STRIDE + i]);
        for (int j = 0; j < N_OTHERS; j++)
          for (int i = 0; i < 3; i++) s.others[j][i][q] = static_cast<T>(others[(j * N + k) * 3 + i]);
      }
    }
    if constexpr (SHAPED) load_shapes(batch, problems, count);
    if constexpr (COMMITTED) load_references(batch, problems, count);
    if constexpr (DISTURBED) load_disturbances(batch, problems, count);
    for (int k = 0; k < N; k++) {
      limit_inputs(stages_[k].u);
      for (int j = 0; j < N_OTHERS; j++) {
        stages_[k].clearance[j] = V{};
        if (batch.clearance)
          for (int q = 0; q < W; q++)
            stages_[k].clearance[j][q] =
                static_cast<T>(batch.clearance[(problems[q < count ? q : count - 1] * N_OTHERS + j) * N + k]);
      }
    }
  }

  void load_shapes(const Batch& batch, const std::int64_t* problems, int count) {
    for (int q = 0; q < W; q++) {
      const std::int64_t first = problems[q < count ? q : count - 1] * N_OTHERS;
      for (int j = 0; j < N_OTHERS; j++) {
        for (int i = 0; i < 3; i++)
          shape_[j][i][q] = static_cast<T>(batch.shape ? batch.shape[(first + j) * 3 + i] : 1.0);
        size_[j][q] = static_cast<T>(batch.size ? batch.size[first + j] : 0.0);
      }
    }
  }

  void load_references(const Batch& batch, const std::int64_t* problems, int count) {
    const bool given = batch.reference && batch.reference_weight;
    for (int k = 0; k < N; k++) {
      Stage<V>& s = stages_[k];
      s.reference[0] = s.reference[1] = s.reference[2] = s.reference_weight[0] = V{};
      for (int q = 0; given && q < W; q++) {
        const std::int64_t row = problems[q < count ? q : count - 1] * N + k;
        for (int i = 0; i < 3; i++) s.reference[i][q] = static_cast<T>(batch.reference[row * 3 + i]);
        s.reference_weight[0][q] = static_cast<T>(2 * batch.reference_weight[row]);
      }
    }
  }

  void load_disturbances(const Batch& batch, const std::int64_t* problems, int count) {
    V disturbance[3] = {};
    for (int i = 0; i < NU; i++) steady_input_[i] = V{};
    for (int q = 0; q < W; q++) {
      const std::int64_t problem = problems[q < count ? q : count - 1];
      if (batch.disturbance)
        for (int i = 0; i < 3; i++) disturbance[i][q] = static_cast<T>(batch.disturbance[problem * 3 + i]);
      if (batch.steady_input)
        for (int i = 0; i < NU; i++)
          steady_input_[i][q] = static_cast<T>(batch.steady_input[problem * INPUT_STRIDE + i]);
    }
    ::drift<V>(disturbance, moved_);
  }

  static void limit_inputs(V* u) {
    for (int i = 0; i < NU; i++) {
      const V low = splat<V>(MIN_INPUT[i]), high = splat<V>(MAX_INPUT[i]);
      u[i] = select<V>(u[i] > high, high, u[i]);  // written so that NaN stays NaN
      u[i] = select<V>(u[i] < low, low, u[i]);
    }
  }

  // Roll the inputs out and linearise about the trajectory: the states of the quadratic program then have no gaps.
  void linearise() {
    const V* x = x0_;
    for (int k = 0; k < N; k++) {
      Stage<V>& s = stages_[k];
      ::linearise<V>(x, s.u, s.x, s.a, s.b);
      if constexpr (DISTURBED) {
        V beyond[NU];
        for (int i = 0; i < NX; i++) s.x[i] += moved_[i];
        for (int i = 0; i < NU; i++) beyond[i] = s.u[i] - steady_input_[i];
        ::input_gradient<V>(beyond, s.input_gradient);
      } else {
        ::input_gradient<V>(s.u, s.input_gradient);
      }
      for (int i = 0; i < NU; i++) {
        s.input_low[i].start(s.u[i] - splat<V>(MIN_INPUT[i]));
        s.input_high[i].start(splat<V>(MAX_INPUT[i]) - s.u[i]);
        s.du[i] = V{};
      }
      x = s.x;
      for (int i = 0; i < N_BOUNDS; i++) {
        // Only the nearer of a state's two bounds enters the problem; the other is out of reach.
        const V low = x[BOUNDED_STATE[i]] - splat<V>(STATE_LOW[i]);
        const V high = splat<V>(STATE_HIGH[i]) - x[BOUNDED_STATE[i]];
        s.bound_sign[i] = select<V>(low < high, splat<V>(1), splat<V>(-1));
        s.bound[i].start(minimum(low, high));
      }
      for (int j = 0; j < N_OTHERS; j++) {
        V distance, gap;
        if constexpr (SHAPED) {
          ::separation<V>(x, s.others[j], shape_[j], &distance, &gap, s.direction[j]);
          distance -= size_[j];
          gap -= size_[j];
        } else {
          ::separation<V>(x, s.others[j], &distance, &gap, s.direction[j]);
        }
        ::repulsion<V>(&distance, &s.repulsion_gradient[j], &s.repulsion_curvature[j]);
        s.separation[j].start(gap - s.clearance[j]);
      }
    }
    ::goal_derivatives<V>(stages_[N - 1].x, x0_, goal_, goal_gradient_, goal_hessian_);
  }

  // Mehrotra's predictor-corrector method.
  void solve_quadratic_program(const Options& options) {
    V complementarity = splat<V>(START_COMPLEMENTARITY), residual = splat<V>(1);
    Mask active = complementarity > V{};
    converged_ = Mask{};
    for (std::int64_t iteration = 0; iteration < options.max_iterations && any(active); iteration++) {
      factorise();
      V overshoot = splat<V>(1), curvature = V{};
      roll_out_step(overshoot, curvature);
      const V part = splat<V>(1) / overshoot;
      // Mean complementarity after the predictor's step, to which the products t lambda shrink linearly.
      const V predicted =
          multiply_add(part * part, curvature * splat<V>(1 / INEQUALITIES), (splat<V>(1) - part) * complementarity);
      const V ratio = predicted / complementarity;
      const V target = maximum(ratio * ratio * predicted, splat<V>(0.1 * options.tolerance));
      correct(target);
      overshoot = splat<V>(STEP_TO_BOUNDARY), curvature = V{};
      roll_out_step(overshoot, curvature);
      const V step = splat<V>(STEP_TO_BOUNDARY) / overshoot;
      V cost;
      advance(active, step, complementarity, cost);
      residual = select<V>(active, residual - step * residual, residual);
      iterations_ -= active;  // a true mask is -1
      const V tolerance = multiply_add(splat<V>(COST_IN_TOLERANCE * options.tolerance), cost, splat<V>(options.tolerance));
      const Mask done = (complementarity < tolerance) & (residual < splat<V>(RESIDUAL_TOLERANCE));
      converged_ |= active & done;
      active &= ~done & (complementarity < splat<V>(1e15));  // false for NaN
    }
  }

  // Backward sweep: eliminate the inequalities, then the Riccati recursion for matrices and, with the predictor's
  // target, for vectors.
  void factorise() {
    V p[N_SYMMETRIC], p_previous[N_SYMMETRIC], costate[NX];
    std::copy(goal_hessian_, goal_hessian_ + N_SYMMETRIC, p);
    std::copy(goal_gradient_, goal_gradient_ + NX, costate);
    for (int k = N - 1; k >= 0; k--) {
      Stage<V>& s = stages_[k];
      for (int i = 0; i < N_BOUNDS; i++) {
        s.bound[i].eliminate();
        p[packed(BOUNDED_STATE[i], BOUNDED_STATE[i])] += s.bound[i].weight();
      }
      for (int j = 0; j < N_OTHERS; j++) {
        s.separation[j].eliminate();
        const V weight = s.separation[j].weight() + s.repulsion_curvature[j];
        for (int i = 0; i < 3; i++)
          for (int l = 0; l <= i; l++)
            p[packed(i, l)] = multiply_add(weight * s.direction[j][i], s.direction[j][l], p[packed(i, l)]);
      }
      if constexpr (COMMITTED)
        for (int i = 0; i < 3; i++) p[packed(i, i)] += s.reference_weight[0];
      V weight[NU];
      for (int i = 0; i < NU; i++) {
        s.input_low[i].eliminate();
        s.input_high[i].eliminate();
        weight[i] = s.input_low[i].weight() + s.input_high[i].weight();
      }
      if (k > 0)
        ::riccati<V>(p, s.a, s.b, weight, s.factor, s.gain, p_previous);
      else
        ::riccati_first<V>(p, s.b, weight, s.factor);
      step_back(k, costate);
      if (k > 0) std::copy(p_previous, p_previous + N_SYMMETRIC, p);
    }
  }

  // Backward sweep with the corrector's target; the factors stay.
  void correct(V target) {
    V costate[NX];
    std::copy(goal_gradient_, goal_gradient_ + NX, costate);
    for (int k = N - 1; k >= 0; k--) {
      Stage<V>& s = stages_[k];
      for (int i = 0; i < N_BOUNDS; i++) s.bound[i].correct(target);
      for (int j = 0; j < N_OTHERS; j++) s.separation[j].correct(target);
      for (int i = 0; i < NU; i++) {
        s.input_low[i].correct(target);
        s.input_high[i].correct(target);
      }
      step_back(k, costate);
    }
  }

  // One stage of the vector recursion: from the costate at stage k + 1 to that at stage k.
  void step_back(int k, V* costate) {
    Stage<V>& s = stages_[k];
    for (int i = 0; i < N_BOUNDS; i++)
      costate[BOUNDED_STATE[i]] =
          negative_multiply_add(s.bound_sign[i], s.bound[i].force(), costate[BOUNDED_STATE[i]]);
    for (int j = 0; j < N_OTHERS; j++) {
      const V force = s.separation[j].force() - s.repulsion_gradient[j];
      for (int i = 0; i < 3; i++) costate[i] = negative_multiply_add(s.direction[j][i], force, costate[i]);
    }
    if constexpr (COMMITTED)
      for (int i = 0; i < 3; i++)
        costate[i] = multiply_add(s.reference_weight[0], s.x[i] - s.reference[i], costate[i]);
    V gradient[NU];
    for (int i = 0; i < NU; i++)
      gradient[i] = s.input_gradient[i] - s.input_low[i].force() + s.input_high[i].force();
    if (k > 0) {
      V costate_previous[NX];
      ::backward<V>(costate, gradient, s.a, s.b, s.factor, s.gain, s.feedforward, costate_previous);
      std::copy(costate_previous, costate_previous + NX, costate);
    } else {
      ::backward_first<V>(costate, gradient, s.b, s.factor, s.feedforward);
    }
  }

  // Forward sweep: the step of inputs and states, and from it that of slacks and multipliers.
  void roll_out_step(V& overshoot, V& curvature) {
    V dx[NX], dx_next[NX];
    for (int k = 0; k < N; k++) {
      Stage<V>& s = stages_[k];
      if (k > 0) {
        ::forward<V>(dx, s.feedforward, s.gain, s.a, s.b, s.new_du, dx_next);
      } else {
        std::copy(s.feedforward, s.feedforward + NU, s.new_du);
        ::forward_first<V>(s.new_du, s.b, dx_next);
      }
      std::copy(dx_next, dx_next + NX, dx);
      for (int i = 0; i < NU; i++) {
        s.input_low[i].direct(s.input_low[i].value + s.new_du[i], overshoot, curvature);
        s.input_high[i].direct(s.input_high[i].value - s.new_du[i], overshoot, curvature);
      }
      for (int i = 0; i < N_BOUNDS; i++)
        s.bound[i].direct(multiply_add(s.bound_sign[i], dx[BOUNDED_STATE[i]], s.bound[i].value), overshoot,
                          curvature);
      for (int j = 0; j < N_OTHERS; j++) {
        V reached = s.separation[j].value;
        for (int i = 0; i < 3; i++) reached = multiply_add(s.direction[j][i], dx[i], reached);
        s.separation[j].direct(reached, overshoot, curvature);
      }
    }
  }

  // Take the step in the active lanes; return their mean complementarity and the cost of violations.
  void advance(Mask active, V step, V& complementarity, V& cost) {
    const V part = select<V>(active, step, V{});
    V sum = V{};
    cost = V{};
    for (int k = 0; k < N; k++) {
      Stage<V>& s = stages_[k];
      for (int i = 0; i < NU; i++) {
        s.du[i] = select<V>(active, multiply_add(part, s.new_du[i] - s.du[i], s.du[i]), s.du[i]);
        s.input_low[i].advance(part, sum, cost);
        s.input_high[i].advance(part, sum, cost);
      }
      for (int i = 0; i < N_BOUNDS; i++) s.bound[i].advance(part, sum, cost);
      for (int j = 0; j < N_OTHERS; j++) s.separation[j].advance(part, sum, cost);
    }
    complementarity = select<V>(active, sum * splat<V>(1 / INEQUALITIES), complementarity);
  }

  void take_step() {
    moving_ = Mask{};
    for (int k = 0; k < N; k++) {
      for (int i = 0; i < NU; i++) {
        const V du = stages_[k].du[i], limit = splat<V>(STILL_MOVING * (MAX_INPUT[i] - MIN_INPUT[i]) / 2);
        stages_[k].u[i] += du;
        moving_ |= (du > limit) | (du < -limit);
      }
      limit_inputs(stages_[k].u);
    }
  }

  void store(const Batch& batch, const std::int64_t* problems, int count) {
    for (int q = 0; q < count; q++) {
      const std::int64_t problem = problems[q];
      double* u = batch.u_plan + problem * N * INPUT_STRIDE;
      for (int k = 0; k < N; k++)
        for (int i = 0; i < INPUT_STRIDE; i++) {
          double value = i < NU ? static_cast<double>(stages_[k].u[i][q]) : 0.0;
          if (i < NU && value > MAX_INPUT[i]) value = MAX_INPUT[i];  // the limit itself rounds in single precision
          if (i < NU && value < MIN_INPUT[i]) value = MIN_INPUT[i];
          u[k * INPUT_STRIDE + i] = value;
        }
      batch.success[problem] = converged_[q] != 0;
      batch.moving[problem] = (converged_[q] & moving_[q]) != 0;
      batch.iterations[problem] += iterations_[q];
    }
  }
};

// States that follow from the inputs found, always in double precision: stage 1 is where the robot will be.
template <int W>
void roll_out(const Batch& batch, std::int64_t first, int count) {
  using V = typename LaneTypes<double, W>::Real;
  V x[NX] = {}, u[NU] = {}, x_next[NX], disturbance[3] = {}, moved[NX] = {};
  for (int q = 0; q < count; q++) {
    const double* from = batch.x + (first + q) * STATE_STRIDE;
    double* to = batch.x_plan + (first + q) * (N + 1) * STATE_STRIDE;
    for (int i = 0; i < STATE_STRIDE; i++) to[i] = from[i];
    for (int i = 0; i < NX; i++) x[i][q] = from[i];
    if (DISTURBED && batch.disturbance)
      for (int i = 0; i < 3; i++) disturbance[i][q] = batch.disturbance[(first + q) * 3 + i];
  }
  if constexpr (DISTURBED) ::drift<V>(disturbance, moved);
  for (int k = 0; k < N; k++) {
    for (int q = 0; q < count; q++)
      for (int i = 0; i < NU; i++) u[i][q] = batch.u_plan[((first + q) * N + k) * INPUT_STRIDE + i];
    ::dynamics<V>(x, u, x_next);
    for (int i = 0; i < NX; i++) x[i] = DISTURBED ? x_next[i] + moved[i] : x_next[i];
    for (int q = 0; q < count; q++) {
      double* to = batch.x_plan + ((first + q) * (N + 1) + k + 1) * STATE_STRIDE;
      for (int i = 0; i < STATE_STRIDE; i++) to[i] = i < NX ? x[i][q] : 0.0;
    }
  }
  for (int q = 0; q < count; q++) {
    double sum = 0;
    for (int i = 0; i < NX; i++) sum += x[i][q];
    if (!std::isfinite(sum)) batch.success[first + q] = 0;
  }
}

template <int W>
void solve_lanes(const Batch& batch, const double* u_guess, const std::int64_t* problems, int count,
                 std::int64_t rounds, const Options& options) {
  static thread_local LaneGroup<REAL, W> group;
  group.solve(batch, u_guess, problems, count, rounds, options);
}

void solve_all(const Batch& batch, const double* u_guess, const std::vector<std::int64_t>& problems,
               std::int64_t rounds, const Options& options) {
  constexpr std::int64_t wide = VECTOR_BYTES / sizeof(REAL), narrow = NARROW_VECTOR_BYTES / sizeof(REAL);
  const std::int64_t count = static_cast<std::int64_t>(problems.size());
  for (std::int64_t first = 0; first < count;) {
    const std::int64_t left = count - first;
    if (left > narrow) {
      solve_lanes<wide>(batch, u_guess, &problems[first], std::min(left, wide), rounds, options);
      first += wide;
    } else {
      solve_lanes<narrow>(batch, u_guess, &problems[first], left, rounds, options);
      first += narrow;
    }
  }
}

}  // namespace

extern "C" __attribute__((visibility("default"))) void quad_swarm_rti(
    std::int64_t count, const double* x, const double* goal, const double* others, const double* clearance,
    const double* shape, const double* size, const double* reference, const double* reference_weight,
    const double* disturbance, const double* steady_input, const double* u_guess, double* x_plan, double* u_plan,
    std::uint8_t* success, std::int64_t* iterations,
    std::int64_t sqp_iterations, std::int64_t extra_iterations, std::int64_t max_iterations, double tolerance) {
  std::vector<std::uint8_t> moving(count);
  const Batch batch{x,           goal,         others, clearance, shape,   size,       reference,    reference_weight,
                    disturbance, steady_input, x_plan, u_plan,    success, iterations, moving.data()};
  const Options options{max_iterations, tolerance};
  std::fill(iterations, iterations + count, 0);
  std::vector<std::int64_t> problems(count);
  std::iota(problems.begin(), problems.end(), 0);
  solve_all(batch, u_guess, problems, sqp_iterations, options);
  // The few problems that have not converged continue together in new groups.
  for (std::int64_t k = 0; k < extra_iterations; k++) {
    const auto settled = [&](std::int64_t problem) { return !moving[problem]; };
    problems.erase(std::remove_if(problems.begin(), problems.end(), settled), problems.end());
    solve_all(batch, u_plan, problems, 1, options);
  }
  constexpr int doubles = VECTOR_BYTES / sizeof(double);
  for (std::int64_t first = 0; first < count; first += doubles)
    roll_out<doubles>(batch, first, static_cast<int>(std::min<std::int64_t>(count - first, doubles)));
}
