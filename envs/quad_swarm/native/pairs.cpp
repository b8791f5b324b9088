// Computations for every pair of robots in every step. pairs.py and steps.py document them, table.py declares their
// parameters. Their NumPy versions give bit-identical results, so the order of operations must not change.
//
// All arrays are contiguous. A trajectory is a row of 3 N numbers, stage by stage. Pairs are ordered by the robot, then
// by the other.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

namespace {

using Integer = std::int64_t;
using Flag = std::uint8_t;

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline double distance(const double* a, const double* b) {
  const double difference[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return std::sqrt(dot(difference, difference));
}

inline double clipped(double value) { return std::min(std::max(value, 0.0), 1.0); }

// The order of operations of NumPy's einsum, in which the presets' separations were first computed
inline double einsum(const double* a, const double* b) { return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1]; }

inline double squared_distance(const double* a, const double* b) {
  const double difference[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return einsum(difference, difference);
}

// Move `position` to where it is at the closest approach of straight motion, until a time at most, and return when that
// is. geometry.py explains it.
template <class Product>
inline double approach(double* position, const double* velocity, double until, Product product) {
  const double speed2 = std::max(product(velocity, velocity), 1e-12);
  const double time = std::min(std::max(-product(position, velocity) / speed2, 0.0), until);
  for (int i = 0; i < 3; i++) position[i] += time * velocity[i];
  return time;
}

// Return the smallest squared distance of two robots that move in straight lines between consecutive positions, which
// are `stride` numbers apart.
double closest(const double* a, const double* b, Integer n_parts, Integer stride) {
  double least = std::numeric_limits<double>::infinity();
  double start[3], end[3];
  for (int i = 0; i < 3; i++) start[i] = a[i] - b[i];
  for (Integer part = 1; part <= n_parts; part++) {
    double change[3];
    for (int i = 0; i < 3; i++) {
      end[i] = a[part * stride + i] - b[part * stride + i];
      change[i] = end[i] - start[i];
    }
    approach(start, change, 1.0, einsum);
    least = std::min(least, einsum(start, start));
    std::copy(end, end + 3, start);
  }
  return least;
}

// Positions at constant velocity. Each time is repeated three times.
inline void steady(const double* pos, const double* vel, const std::vector<double>& times, double* to) {
  for (std::size_t k = 0; k < times.size(); k += 3)
    for (int i = 0; i < 3; i++) to[k + i] = vel[i] * times[k + i] + pos[i];
}

// A layer of a network: its biases, then a row of weights for each input. Returns where the next layer's weights are.
const float* layer(const float* weights, const float* in, Integer n_in, Integer n_out, bool rectified, float* out) {
  constexpr Integer block = 32;  // fits into registers, and hides the latency of additions
  for (Integer from = 0; from < n_out; from += block) {
    // The last block overlaps the one before
    const Integer first = n_out < block ? 0 : std::min(from, n_out - block), count = std::min(block, n_out);
    float sums[block];
    if (count == block) {
      for (Integer k = 0; k < block; k++) sums[k] = weights[first + k];
      for (Integer i = 0; i < n_in; i++) {
        const float* row = weights + (i + 1) * n_out + first;
        for (Integer k = 0; k < block; k++) sums[k] += in[i] * row[k];
      }
    } else {
      for (Integer k = 0; k < count; k++) sums[k] = weights[k];
      for (Integer i = 0; i < n_in; i++)
        for (Integer k = 0; k < count; k++) sums[k] += in[i] * weights[(i + 1) * n_out + k];
    }
    for (Integer k = 0; k < count; k++) out[first + k] = rectified ? std::max(sums[k], 0.0f) : sums[k];
  }
  return weights + (n_in + 1) * n_out;
}

// The record of `STATISTICS` in table.py
struct Statistics {
  Integer steps, steps_counted, requests, possible_requests, peak_requests, plans_used, plan_ages, requests_flown;
  Integer planner_failures;
  double path_length, min_separation, min_separation_continuous, solve_seconds;
  Flag at_goals, reached, arrived, collided, collided_at_steps, collided_continuous;
};

}  // namespace

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

EXPORT void quad_swarm_remember(Integer n_pairs, Integer n_stages, double memory, const double* pos,
                                const double* remembered, const Integer* age, double* next, Integer* next_age,
                                double* error, Flag* remembers) {
  const Integer row = 3 * (n_stages + 1);
  for (Integer pair = 0; pair < n_pairs; pair++) {
    const double* from = remembered + row * pair;
    double* to = next + row * pair;
    std::memcpy(to, from + 3, (row - 3) * sizeof(double));
    for (int i = 0; i < 3; i++) to[row - 3 + i] = 2 * from[row - 3 + i] - from[row - 6 + i];
    error[pair] = distance(to, pos + 3 * pair);
    next_age[pair] = age[pair] + 1;
    remembers[pair] = next_age[pair] < n_stages && error[pair] <= memory;
  }
}

EXPORT void quad_swarm_believe(Integer n_pairs, Integer n_stages, Integer n_chosen, double dt, const Integer* chosen,
                               const double* pos, const double* vel, const double* remembered, const Flag* remembers,
                               double* believed) {
  std::vector<double> times(3 * n_chosen);
  for (Integer k = 0; k < 3 * n_chosen; k++) times[k] = dt * static_cast<double>(chosen[k / 3] + 1);
  for (Integer pair = 0; pair < n_pairs; pair++) {
    const double* from = remembered + 3 * (n_stages + 1) * pair;
    double* to = believed + 3 * n_chosen * pair;
    if (!remembers[pair]) {
      steady(pos + 3 * pair, vel + 3 * pair, times, to);
    } else {
      for (Integer k = 0; k < n_chosen; k++) std::memcpy(to + 3 * k, from + 3 * (chosen[k] + 1), 3 * sizeof(double));
    }
  }
}

// `ages` null: all answers are as old as `age`. `remembered` null: without memory. `believed` null: not needed.
EXPORT void quad_swarm_receive(Integer n_pairs, Integer n_stages, Integer age, double dt, double misfit,
                               const Flag* arriving,
                               const double* received, const Integer* ages, const double* pos, const double* vel,
                               const Flag* remembers, const Integer* known_age, const double* known, double* remembered,
                               Integer* next_age, double* believed, Integer* source) {
  const Integer row = 3 * n_stages;
  std::vector<double> times(row);
  for (Integer k = 0; k < row; k++) times[k] = dt * static_cast<double>(k / 3 + 1);
  Integer answer = 0;
  for (Integer pair = 0; pair < n_pairs; pair++) {
    bool arrives = arriving[pair], believes = remembers[pair];
    const double* plan = known + (row + 3) * pair;
    next_age[pair] = known_age[pair];
    if (arrives) {
      const Integer made = ages ? ages[answer] : age;
      arrives = !ages || made <= known_age[pair];  // otherwise a newer one has arrived before
      if (arrives) {
        plan = received + (row + 3) * answer;
        next_age[pair] = made;
        believes = made < n_stages && distance(plan, pos + 3 * pair) <= misfit;
        if (remembered) std::memcpy(remembered + (row + 3) * pair, plan, (row + 3) * sizeof(double));
      }
      answer++;
    }
    if (!believed) continue;
    source[pair] = !believes ? 0 : arrives ? 2 : 1;
    if (source[pair])
      std::memcpy(believed + row * pair, plan + 3, row * sizeof(double));
    else
      steady(pos + 3 * pair, vel + 3 * pair, times, believed + row * pair);
  }
}

EXPORT void quad_swarm_approach(Integer n_robots, Integer n_others, Integer n_stages, double dt, const double* own,
                                const double* plan, const double* pos, const double* vel, const double* remembered,
                                const Flag* remembers, double* least, Integer* nearest, double* last) {
  std::vector<double> times(3 * n_stages), buffer(3 * n_stages), distances(n_stages);
  for (Integer k = 0; k < 3 * n_stages; k++) times[k] = dt * static_cast<double>(k / 3 + 1);
  for (Integer robot = 0; robot < n_robots; robot++) {
    const double *mine = plan + 3 * n_stages * robot, *origin = own + 3 * robot;
    for (Integer pair = robot * n_others; pair < (robot + 1) * n_others; pair++) {
      const double* theirs = remembered + 3 * (n_stages + 1) * pair + 3;
      if (!remembers[pair]) {
        steady(pos + 3 * pair, vel + 3 * pair, times, buffer.data());
        theirs = buffer.data();
      }
      for (Integer k = 0; k < n_stages; k++) {
        double between[3];
        for (int i = 0; i < 3; i++) between[i] = mine[3 * k + i] - (theirs[3 * k + i] - origin[i]);
        distances[k] = std::sqrt(dot(between, between));
      }
      nearest[pair] = std::min_element(distances.begin(), distances.end()) - distances.begin();
      least[pair] = distances[nearest[pair]];
      last[pair] = distances[n_stages - 1];
    }
  }
}

EXPORT void quad_swarm_nearest_obstacle(Integer n_swarms, Integer n_pairs, Integer n_stages, Integer n_obstacles,
                                        const double* trajectories, const double* radii, const double* centres,
                                        const double* factors, const double* radius, const Flag* present, double* gap,
                                        Integer* stage, double* towards) {
  for (Integer pair = 0; pair < n_swarms * n_pairs; pair++) {
    const double* path = trajectories + 3 * n_stages * pair;
    double least = std::numeric_limits<double>::infinity(), away = 1.0, way[3] = {0.0, 0.0, 0.0};
    Integer reached = 0;
    const Integer first = pair / n_pairs * n_obstacles;
    for (Integer obstacle = first; obstacle < first + n_obstacles; obstacle++) {
      if (!present[obstacle]) continue;
      const double *factor = factors + 3 * obstacle, *centre = centres + 3 * n_stages * obstacle;
      const double reach = radius[obstacle] + radii[pair];
      for (Integer k = 0; k < n_stages; k++) {
        double between[3];
        for (int i = 0; i < 3; i++) between[i] = factor[i] * (centre[3 * k + i] - path[3 * k + i]);
        const double apart = std::sqrt(dot(between, between));
        if (!(apart - reach < least)) continue;
        least = apart - reach, away = apart, reached = k;
        std::copy(between, between + 3, way);
      }
    }
    gap[pair] = least, stage[pair] = reached;
    for (int i = 0; i < 3; i++) towards[3 * pair + i] = way[i] / std::max(away, 1e-6);
  }
}

EXPORT void quad_swarm_resample(Integer n_robots, Integer n_rows, Integer n_stages, const double* later,
                                double* trajectories) {
  for (Integer robot = 0; robot < n_robots; robot++) {
    for (Integer k = robot * n_rows; k < (robot + 1) * n_rows; k++) {
      double* row = trajectories + 3 * n_stages * k;
      const Integer last = 3 * (n_stages - 1);
      double piece[3];
      for (int i = 0; i < 3; i++) piece[i] = (row[last + i] - row[last - 3 + i]) * later[robot];
      for (Integer j = 0; j < last; j++) row[j] += (row[j + 3] - row[j]) * later[robot];
      for (int i = 0; i < 3; i++) row[last + i] += piece[i];
    }
  }
}

EXPORT void quad_swarm_keep_right(Integer n_robots, Integer n_others, Integer n_stages, double width, double dt,
                                  double fade, double slow, const double* x, const Flag* known, double* others,
                                  double* clearance) {
  for (Integer pair = 0; pair < n_robots * n_others; pair++) {
    if (!known[pair]) continue;
    const double* state = x + 9 * (pair / n_others);
    double* row = others + 3 * n_stages * pair;
    double pos[3], vel[3];
    for (int i = 0; i < 3; i++) {
      const double velocity = (row[3 + i] - row[i]) / dt;
      pos[i] = row[i] - dt * velocity - state[i];
      vel[i] = velocity - state[3 + i];
    }
    const double speed = std::hypot(vel[0], vel[1]);
    const double grown = width * (approach(pos, vel, fade, dot) / fade) * clipped(speed / slow);
    const double shift[2] = {grown * (vel[1] / std::max(speed, 1e-9)), grown * (-vel[0] / std::max(speed, 1e-9))};
    for (Integer k = 0; k < n_stages; k++) {
      row[3 * k] += shift[0];
      row[3 * k + 1] += shift[1];
      clearance[n_stages * pair + k] += grown;
    }
  }
}

// `errors` null: robots observe each other without errors.
EXPORT void quad_swarm_neighbours(Integer n_swarms, Integer n_robots, Integer n_slots, double limit, double look_ahead,
                                  const double* pos, const double* vel, const double* errors, Integer* others,
                                  Flag* present, Integer* reverse) {
  std::vector<std::pair<double, Integer>> near;
  std::vector<Flag> comes(n_robots);
  std::vector<const double*> error(n_robots, nullptr);  // of each other that is in a slot
  for (Integer swarm = 0; swarm < n_swarms; swarm++) {
    const double *swarm_pos = pos + 3 * n_robots * swarm, *swarm_vel = vel + 3 * n_robots * swarm;
    const Integer first = n_slots * n_robots * swarm;
    for (Integer robot = 0; robot < n_robots; robot++) {
      near.clear();
      for (Integer k = first + n_slots * robot; errors && k < first + n_slots * (robot + 1); k++)
        if (present[k]) error[others[k]] = errors + 6 * k;
      for (Integer other = 0; other < n_robots; other++) {
        double apart[3], along[3];
        for (int i = 0; i < 3; i++) {
          apart[i] = swarm_pos[3 * robot + i] - swarm_pos[3 * other + i];
          along[i] = swarm_vel[3 * robot + i] - swarm_vel[3 * other + i];
          if (error[other]) apart[i] -= error[other][i];
          if (error[other]) along[i] -= error[other][i + 3];
        }
        error[other] = nullptr;
        if (other == robot || dot(apart, apart) > limit * limit) continue;
        approach(apart, along, look_ahead, dot);
        near.emplace_back(dot(apart, apart), other);
      }
      if (static_cast<Integer>(near.size()) > n_slots) {
        std::nth_element(near.begin(), near.begin() + n_slots, near.end());
        near.resize(n_slots);
      }
      std::fill(comes.begin(), comes.end(), 0);
      for (const auto& one : near) comes[one.second] = 1;
      Integer* who = others + first + n_slots * robot;
      Flag* taken = present + first + n_slots * robot;
      for (Integer slot = 0; slot < n_slots; slot++) {
        taken[slot] = taken[slot] && comes[who[slot]];
        if (taken[slot])
          comes[who[slot]] = 0;
        else
          who[slot] = robot;
      }
      Integer slot = 0;
      for (Integer other = 0; other < n_robots; other++) {
        if (!comes[other]) continue;
        while (taken[slot]) slot++;
        who[slot] = other;
        taken[slot] = 1;
      }
    }
    for (Integer robot = 0; robot < n_robots; robot++) {
      for (Integer k = first + n_slots * robot; k < first + n_slots * (robot + 1); k++) {
        const Integer* theirs = others + first + n_slots * others[k];
        const Integer* found = std::find(theirs, theirs + n_slots, robot);
        reverse[k] = present[k] && found != theirs + n_slots ? found - theirs : -1;
      }
    }
  }
}

// Without `others`, the swarms' results for pairs lie next to each other.
EXPORT void quad_swarm_measure(Integer n_parts, Integer n_swarms, Integer n_robots, Integer n_slots, double contact,
                               double goal_radius, const double* positions, const double* goals, const Integer* others,
                               double* min_separation, double* min_separation_continuous, double* separation,
                               double* separation_continuous, Flag* colliding, Flag* colliding_continuous,
                               double* moved, Flag* at_goal) {
  const double infinity = std::numeric_limits<double>::infinity();
  const Integer stride = 3 * n_robots * n_swarms, last = stride * n_parts;
  std::vector<double> after(n_robots * n_robots, infinity), during(n_robots * n_robots, infinity);
  for (Integer swarm = 0; swarm < n_swarms; swarm++) {
    const double* pos = positions + 3 * n_robots * swarm;
    min_separation[swarm] = min_separation_continuous[swarm] = infinity;
    for (Integer robot = 0; robot < n_robots; robot++) {
      for (Integer other = robot + 1; other < n_robots; other++) {
        const Integer one = n_robots * robot + other, two = n_robots * other + robot;
        after[one] = after[two] = std::sqrt(squared_distance(pos + last + 3 * robot, pos + last + 3 * other));
        during[one] = during[two] = std::sqrt(closest(pos + 3 * robot, pos + 3 * other, n_parts, stride));
        min_separation[swarm] = std::min(min_separation[swarm], after[one]);
        min_separation_continuous[swarm] = std::min(min_separation_continuous[swarm], during[one]);
      }
    }
    for (Integer robot = 0; robot < n_robots; robot++) {
      for (Integer slot = 0; slot < n_slots; slot++) {
        const Integer pair = n_slots * robot + slot, pairs = n_slots * n_robots;
        const Integer other = others ? others[pairs * swarm + pair] : slot + (slot >= robot);
        const Integer k = others ? pairs * swarm + pair : n_swarms * pair + swarm;
        separation[k] = after[n_robots * robot + other];
        separation_continuous[k] = during[n_robots * robot + other];
        colliding[k] = separation[k] < contact;
        colliding_continuous[k] = separation_continuous[k] < contact;
      }
      const Integer number = n_robots * swarm + robot;
      const double* now = pos + last + 3 * robot;
      moved[number] = std::sqrt(squared_distance(now, pos + 3 * robot));
      at_goal[number] = squared_distance(now, goals + 3 * number) <= goal_radius * goal_radius;
    }
  }
}

EXPORT void quad_swarm_count(Integer n_swarms, Integer n_robots, Integer n_slots, Integer failed, double seconds,
                             const Integer* n_requests, const Flag* collided, const Flag* collision,
                             const Flag* collision_continuous, const Flag* at_goal, const Integer* belief_source,
                             const Integer* plan_age, const Integer* plan_status, const Integer* others,
                             const double* moved, const double* min_separation,
                             const double* min_separation_continuous, Statistics* statistics) {
  const Integer n_pairs = n_robots * n_slots;
  for (Integer swarm = 0; swarm < n_swarms; swarm++) {
    Statistics& sum = statistics[swarm];
    if (!sum.reached && !sum.collided) {
      Integer used = 0, ages = 0, possible = others ? 0 : n_pairs;
      for (Integer pair = n_pairs * swarm; pair < n_pairs * (swarm + 1); pair++) {
        used += belief_source[pair] != 0;
        ages += belief_source[pair] != 0 ? plan_age[pair] : 0;
        possible += others && others[pair] >= 0;
      }
      sum.steps_counted++;
      sum.requests += n_requests[swarm];
      sum.possible_requests += possible;
      sum.peak_requests = std::max(sum.peak_requests, n_requests[swarm]);
      sum.plans_used += used;
      sum.plan_ages += ages;
      sum.path_length += moved[swarm];
    }
    sum.steps++;
    sum.requests_flown += n_requests[swarm];
    sum.collided |= collided[swarm];
    sum.collided_at_steps |= collision[swarm];
    sum.collided_continuous |= collision_continuous[swarm];
    sum.at_goals = 1;
    for (Integer robot = n_robots * swarm; robot < n_robots * (swarm + 1); robot++) {
      sum.at_goals &= at_goal[robot];
      sum.planner_failures += plan_status[robot] >= failed;
    }
    sum.arrived |= sum.at_goals && !sum.collided;
    sum.reached |= sum.at_goals;
    sum.min_separation = std::min(sum.min_separation, min_separation[swarm]);
    sum.min_separation_continuous = std::min(sum.min_separation_continuous, min_separation_continuous[swarm]);
    sum.solve_seconds += seconds / static_cast<double>(n_swarms);
  }
}

EXPORT void quad_swarm_anticipate(Integer n_swarms, Integer n_robots, Integer n_bodies, Integer n_targets,
                                  Integer n_obstacles, Integer n_stages, Integer hidden, Integer width, double dt,
                                  const float* weights, const double* pos, const double* vel, const Integer* place,
                                  const double* changes, const Flag* skipped, const double* centres,
                                  const double* velocities, const double* factors, const double* radius,
                                  double* expected) {
  std::vector<float> first(hidden), second(hidden), head(8 + 2 * hidden), one(width), two(width), out(3 * n_stages);
  for (Integer target = 0; target < n_swarms * n_robots * n_targets; target++) {
    const Integer view = target / n_targets, swarm = view / n_robots;
    const Integer self = place[view % n_robots * n_targets + target % n_targets];
    const double *where = pos + 3 * (view * n_bodies + self), *way = vel + 3 * (view * n_bodies + self);
    double* to = expected + 3 * (n_stages + 1) * target;
    if (skipped[target]) {
      for (Integer k = 0; k <= n_stages; k++)
        for (int i = 0; i < 3; i++) to[3 * k + i] = where[i] + dt * static_cast<double>(k) * way[i];
      continue;
    }
    const double speed = std::sqrt(way[0] * way[0] + way[1] * way[1]);
    const bool moves = speed > 1e-3;
    const double c = moves ? way[0] / speed : 1.0, s = moves ? way[1] / speed : 0.0;
    std::fill(head.begin(), head.end(), 0.0f);
    const double *recent = changes + 6 * target, *earlier = recent + 3;
    const double own[8] = {speed, way[2],
                           5 * (c * recent[0] + s * recent[1]), 5 * (c * recent[1] - s * recent[0]), 5 * recent[2],
                           3 * (c * earlier[0] + s * earlier[1]), 3 * (c * earlier[1] - s * earlier[0]), 3 * earlier[2]};
    for (int i = 0; i < 8; i++) head[i] = static_cast<float>(own[i]);
    const float* after = weights;
    for (Integer body = 0; body < n_bodies + n_obstacles; body++) {
      if (body == self) continue;
      double away[3], relative[3], shrunk = 1.0;
      const bool robot = body < n_bodies;
      if (robot) {
        const Integer other = 3 * (view * n_bodies + body);
        for (int i = 0; i < 3; i++) away[i] = pos[other + i] - where[i], relative[i] = vel[other + i] - way[i];
      } else {
        const Integer other = swarm * n_obstacles + body - n_bodies;
        if (!(radius[other] > 0)) continue;
        for (int i = 0; i < 3; i++) {
          away[i] = factors[3 * other + i] * (centres[3 * other + i] - where[i]);
          relative[i] = factors[3 * other + i] * (velocities[3 * other + i] - way[i]);
        }
        const double apart = std::sqrt(dot(away, away));
        shrunk = std::max(1.0 - (radius[other] - 0.3) / std::max(apart, 1e-6), 0.1);
      }
      const double near = clipped(6.0 - std::sqrt(dot(away, away)));
      if (!(near > 0)) continue;
      for (int i = 0; i < 3; i++) away[i] *= shrunk;
      const float in[7] = {static_cast<float>((c * away[0] + s * away[1]) / 3),
                           static_cast<float>((c * away[1] - s * away[0]) / 3),
                           static_cast<float>(away[2] / 3),
                           static_cast<float>((c * relative[0] + s * relative[1]) / 4),
                           static_cast<float>((c * relative[1] - s * relative[0]) / 4),
                           static_cast<float>(relative[2] / 4),
                           robot ? 0.0f : 1.0f};
      layer(layer(weights, in, 7, hidden, true, first.data()), first.data(), hidden, hidden, true, second.data());
      const float weight = static_cast<float>(near);
      for (Integer k = 0; k < hidden; k++) {
        const float value = weight * second[k];
        head[8 + k] += value;
        head[8 + hidden + k] = std::max(head[8 + hidden + k], value);
      }
    }
    after += 8 * hidden + (hidden + 1) * hidden;
    after = layer(after, head.data(), 8 + 2 * hidden, width, true, one.data());
    after = layer(after, one.data(), width, width, true, two.data());
    layer(after, two.data(), width, 3 * n_stages, false, out.data());
    std::copy(where, where + 3, to);
    for (Integer k = 0; k < n_stages; k++) {
      const double time = dt * static_cast<double>(k + 1);
      const double x = out[3 * k], y = out[3 * k + 1], z = out[3 * k + 2];
      to[3 * k + 3] = where[0] + time * (way[0] + (c * x - s * y));
      to[3 * k + 4] = where[1] + time * (way[1] + (s * x + c * y));
      to[3 * k + 5] = where[2] + time * (way[2] + z);
    }
  }
}
