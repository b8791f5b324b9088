/* The rival: a real-time iteration on HPIPM (what acados runs), one problem after the other.
 *
 * Linearised by C code that CasADi generates (stage, separation, goal). x_0 is eliminated; one slack for each (stage,
 * robot); workspace and speed limits are hard bounds, which is faster than soft ones. */
#include <stdlib.h>
#include <string.h>

#include "blasfeo.h"
#include "hpipm_d_ocp_qp.h"
#include "hpipm_d_ocp_qp_dim.h"
#include "hpipm_d_ocp_qp_ipm.h"
#include "hpipm_d_ocp_qp_sol.h"

typedef long long int casadi_int;
int stage(const double **arg, double **res, casadi_int *iw, double *w, int mem);
int separation(const double **arg, double **res, casadi_int *iw, double *w, int mem);
int goal_cost(const double **arg, double **res, casadi_int *iw, double *w, int mem);

enum { N = OCP_N, NX = OCP_NX, NU = OCP_NU, OTHERS = OCP_OTHERS };
enum { STATES = 9, INPUTS = 4 }; /* strides of the caller's arrays */

static struct d_ocp_qp_dim dim;
static struct d_ocp_qp qp;
static struct d_ocp_qp_sol sol;
static struct d_ocp_qp_ipm_arg arg;
static struct d_ocp_qp_ipm_ws ws;
static double max_input[NU], low[6], high[6], r_matrix[NU * NU];

static void *memory(size_t size) { return calloc(1, size); }

/* bounds: max_input (NU), low (6), high (6) of the first six states; hessian: of the input cost (NU, NU). */
void hpipm_create(const double *bounds, const double *hessian, double violation_weight) {
  memcpy(max_input, bounds, sizeof max_input);
  memcpy(low, bounds + NU, sizeof low);
  memcpy(high, bounds + NU + 6, sizeof high);
  memcpy(r_matrix, hessian, sizeof r_matrix);
  int nx[N + 1], nu[N + 1], nbx[N + 1], nbu[N + 1], ng[N + 1], ns[N + 1];
  for (int k = 0; k <= N; k++) {
    nx[k] = k > 0 ? NX : 0;
    nu[k] = nbu[k] = k < N ? NU : 0;
    nbx[k] = k > 0 ? 6 : 0;
    ng[k] = ns[k] = k > 0 ? OTHERS : 0;
  }
  d_ocp_qp_dim_create(N, &dim, memory(d_ocp_qp_dim_memsize(N)));
  d_ocp_qp_dim_set_all(nx, nu, nbx, nbu, ng, ns, &dim);
  d_ocp_qp_create(&dim, &qp, memory(d_ocp_qp_memsize(&dim)));
  d_ocp_qp_sol_create(&dim, &sol, memory(d_ocp_qp_sol_memsize(&dim)));
  d_ocp_qp_ipm_arg_create(&dim, &arg, memory(d_ocp_qp_ipm_arg_memsize(&dim)));
  d_ocp_qp_ipm_arg_set_default(SPEED, &arg);
  int iterations = 30;
  double mu0 = 10, tolerance = 1e-4;
  d_ocp_qp_ipm_arg_set_iter_max(&iterations, &arg);
  d_ocp_qp_ipm_arg_set_mu0(&mu0, &arg);
  d_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &arg);
  d_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &arg);
  d_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &arg);
  d_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &arg);
  d_ocp_qp_ipm_ws_create(&dim, &arg, &ws, memory(d_ocp_qp_ipm_ws_memsize(&dim, &arg)));

  int indices[NU + 6 + OTHERS];
  double weight[OTHERS], zero[OTHERS] = {0};
  for (int i = 0; i < NU + 6 + OTHERS; i++) indices[i] = i;
  for (int j = 0; j < OTHERS; j++) weight[j] = 2 * violation_weight;
  for (int k = 0; k <= N; k++) {
    if (k < N) {
      d_ocp_qp_set_idxbu(k, indices, &qp);
      d_ocp_qp_set_R(k, r_matrix, &qp);
    }
    if (k == 0) continue;
    d_ocp_qp_set_idxbx(k, indices, &qp);
    d_ocp_qp_set_ug_mask(k, zero, &qp);
    d_ocp_qp_set_idxs(k, indices + (k < N ? NU : 0) + 6, &qp);
    d_ocp_qp_set_Zl(k, weight, &qp);
    d_ocp_qp_set_Zu(k, weight, &qp);
    d_ocp_qp_set_zl(k, zero, &qp);
    d_ocp_qp_set_zu(k, zero, &qp);
  }
}

static void set_state_stage(int k, const double *x, const double *x0, const double *goal, const double *others) {
  static double w[4096];
  double q_matrix[NX * NX] = {0}, q[NX] = {0}, c[OTHERS * NX] = {0}, gap[OTHERS], bound_low[6], bound_high[6];
  if (k == N) {
    const double *in[] = {x, x0, goal};
    double *out[] = {q, q_matrix};
    goal_cost(in, out, 0, w, 0);
  }
  for (int j = 0; j < OTHERS; j++) {
    double violation, n[3], gradient, curvature;
    const double *in[] = {x, others + (j * N + k - 1) * 3};
    double *out[] = {&violation, n, &gradient, &curvature};
    separation(in, out, 0, w, 0);
    gap[j] = violation;
    for (int i = 0; i < 3; i++) {
      c[i * OTHERS + j] = n[i];
      q[i] += gradient * n[i];
      for (int l = 0; l < 3; l++) q_matrix[i * NX + l] += curvature * n[i] * n[l];
    }
  }
  for (int i = 0; i < 6; i++) {
    bound_low[i] = low[i] - x[i];
    bound_high[i] = high[i] - x[i];
  }
  d_ocp_qp_set_Q(k, q_matrix, &qp);
  d_ocp_qp_set_q(k, q, &qp);
  d_ocp_qp_set_C(k, c, &qp);
  d_ocp_qp_set_lg(k, gap, &qp);
  d_ocp_qp_set_lbx(k, bound_low, &qp);
  d_ocp_qp_set_ubx(k, bound_high, &qp);
}

/* Arrays as in the batched solver; x and u hold the guess on entry and the plan on return. */
void hpipm_solve(casadi_int count, const double *x0, const double *goal, const double *others, double *x, double *u,
                 unsigned char *success, casadi_int *iterations, casadi_int sqp_iterations) {
  static double w[4096];
  for (casadi_int b = 0; b < count; b++, x += (N + 1) * STATES, u += N * INPUTS) {
    memcpy(x, x0 + b * STATES, STATES * sizeof *x);
    iterations[b] = 0;
    success[b] = 1;
    for (casadi_int s = 0; s < sqp_iterations; s++) {
      for (int k = 0; k < N; k++) {
        double next[NX], a[NX * NX], bm[NX * NU], r[NU], bound_low[NU], bound_high[NU];
        const double *in[] = {x + k * STATES, u + k * INPUTS};
        double *out[] = {next, a, bm, r};
        stage(in, out, 0, w, 0);
        for (int i = 0; i < NX; i++) next[i] -= x[(k + 1) * STATES + i];
        for (int i = 0; i < NU; i++) {
          bound_low[i] = -max_input[i] - u[k * INPUTS + i];
          bound_high[i] = max_input[i] - u[k * INPUTS + i];
        }
        if (k > 0) d_ocp_qp_set_A(k, a, &qp);
        d_ocp_qp_set_B(k, bm, &qp);
        d_ocp_qp_set_b(k, next, &qp);
        d_ocp_qp_set_r(k, r, &qp);
        d_ocp_qp_set_lbu(k, bound_low, &qp);
        d_ocp_qp_set_ubu(k, bound_high, &qp);
        set_state_stage(k + 1, x + (k + 1) * STATES, x0 + b * STATES, goal + b * 3, others + b * OTHERS * N * 3);
      }
      d_ocp_qp_ipm_solve(&qp, &sol, &arg, &ws);
      int status, count_iterations;
      d_ocp_qp_ipm_get_status(&ws, &status);
      d_ocp_qp_ipm_get_iter(&ws, &count_iterations);
      iterations[b] += count_iterations;
      if (status != 0) success[b] = 0;
      for (int k = 0; k <= N; k++) {
        double step[NX];
        if (k < N) {
          d_ocp_qp_sol_get_u(k, &sol, step);
          for (int i = 0; i < NU; i++) u[k * INPUTS + i] += step[i];
        }
        if (k > 0) {
          d_ocp_qp_sol_get_x(k, &sol, step);
          for (int i = 0; i < NX; i++) x[k * STATES + i] += step[i];
        }
      }
    }
  }
}
