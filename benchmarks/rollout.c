/* The rotary pendulum under its sliding-mode law, written by hand for one job: many surfaces,
   one initial state, fixed length, energy and final state.  Blocks of LANES loops, structure of
   arrays, inline polynomial sine and cosine: what a careful programmer would write in C for
   `gcc -O3 -march=native -ffast-math`. */
#include <math.h>
#include <stddef.h>

#define LANES 32

typedef struct { double a, b, c, d, d_e, a_e, limit, eta, layer; } parameters;

static inline void sincos_inline(double x, double *s, double *c)
{
    double k = floor(x * 0.6366197723675814 + 0.5);
    double r = (x - k * 1.5707963267341256) - k * 6.077100506506192e-11;
    double z = r * r;
    double ps = r + r * z * (-0.16666666666666632 + z * (0.00833333333332249
        + z * (-0.0001984126982985795 + z * (2.7557313707070068e-06
        + z * (-2.5050760253406863e-08 + z * 1.58969099521155e-10)))));
    double pc = 1.0 - 0.5 * z + z * z * (0.0416666666666666 + z * (-0.001388888888887411
        + z * (2.480158728947673e-05 + z * (-2.7557314351390663e-07
        + z * (2.087572321298175e-09 + z * -1.1359647557788195e-11)))));
    double h = floor(k * 0.5), odd = k - 2.0 * h;
    double sign = 1.0 - 2.0 * (h - 2.0 * floor(h * 0.5));
    *s = sign * (odd == 0.0 ? ps : pc);
    *c = sign * (1.0 - 2.0 * odd) * (odd == 0.0 ? pc : ps);
}

/* x0: 4 numbers; surfaces: count x 4 (alpha_a, lambda_a, alpha_u, lambda_u); out: count x 5
   (energy, final state).  count is a multiple of LANES. */
void rollout(const double *x0, const double *surfaces, size_t count, long steps, double step,
             const parameters *p, double *out)
{
    const double a = p->a, b = p->b, c = p->c, d = p->d, d_e = p->d_e, a_e = p->a_e;
    const double limit = p->limit, eta = p->eta, per_layer = 1.0 / p->layer, per_c = 1.0 / c;
    const double per_a_e = 1.0 / a_e;
    double aa[LANES], la[LANES], au[LANES], lu[LANES];
    double x[4][LANES], y[4][LANES], acc[4][LANES], cost[LANES], cacc[LANES];
    for (size_t block = 0; block < count; block += LANES) {
        for (int i = 0; i < LANES; i++) {
            const double *s = surfaces + 4 * (block + (size_t)i);
            aa[i] = s[0]; la[i] = s[1]; au[i] = s[2]; lu[i] = s[3];
            for (int j = 0; j < 4; j++) { x[j][i] = x0[j]; y[j][i] = x0[j]; acc[j][i] = 0.0; }
            cost[i] = 0.0;
        }
        for (long n = 0; n < steps; n++) {
            for (int stage = 0; stage < 4; stage++) {
                const double weight = (stage == 0 || stage == 3) ? 1.0 : 2.0;
                const double reach = (stage < 2) ? 0.5 * step : step;
                const double keep = stage == 0 ? 0.0 : 1.0;
                for (int i = 0; i < LANES; i++) {
                    const double th = y[0][i], ph = y[1][i], w = y[2][i], v = y[3][i];
                    double sn, cs;
                    sincos_inline(ph, &sn, &cs);
                    const double m_au = -b * cs, X = m_au * per_c;
                    const double f_u = d * sn + c * sn * cs * w * w;
                    const double f_a = -b * sn * v * v - 2.0 * c * sn * cs * v * w - d_e * w;
                    const double fy = f_u * per_c;
                    const double S = a + c * sn * sn - m_au * X;
                    const double h = f_a - m_au * fy;
                    const double s = aa[i] * w + la[i] * th + au[i] * v + lu[i] * ph;
                    double sat = s * per_layer;
                    sat = sat > 1.0 ? 1.0 : sat;
                    sat = sat < -1.0 ? -1.0 : sat;
                    const double gamma = aa[i] - au[i] * X;
                    const double drive = au[i] * fy + la[i] * w + lu[i] * v + eta * sat;
                    double u = (-S * drive / gamma - h) * per_a_e;
                    u = u > limit ? limit : u;
                    u = u < -limit ? -limit : u;
                    const double q_a = (h + a_e * u) / S, q_u = fy - X * q_a;
                    acc[0][i] = keep * acc[0][i] + weight * w;
                    acc[1][i] = keep * acc[1][i] + weight * v;
                    acc[2][i] = keep * acc[2][i] + weight * q_a;
                    acc[3][i] = keep * acc[3][i] + weight * q_u;
                    cacc[i] = stage == 0 ? u * u : cacc[i] + weight * u * u;
                    y[0][i] = x[0][i] + reach * w;
                    y[1][i] = x[1][i] + reach * v;
                    y[2][i] = x[2][i] + reach * q_a;
                    y[3][i] = x[3][i] + reach * q_u;
                }
            }
            for (int i = 0; i < LANES; i++) {
                for (int j = 0; j < 4; j++) {
                    x[j][i] += step / 6.0 * acc[j][i];
                    y[j][i] = x[j][i];
                }
                cost[i] += step / 6.0 * cacc[i];
            }
        }
        for (int i = 0; i < LANES; i++) {
            double *o = out + 5 * (block + (size_t)i);
            o[0] = cost[i];
            for (int j = 0; j < 4; j++) o[1 + j] = x[j][i];
        }
    }
}
