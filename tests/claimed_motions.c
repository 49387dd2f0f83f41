/* Motions of the rotary pendulum under its sliding-mode law, for tests/claimed_motions.py.
 *
 * Written by hand from the Lagrangian of a uniform rod on an arm and from ṡ = −η sat(s/ε); nothing
 * is generated, and nothing is shared with what proves.  Units are SI, angles radians.  The state
 * is (θ, φ, θ̇, φ̇); θ has the motor.  Classical Runge-Kutta of fourth order. */
#include <math.h>
#include <stdint.h>

enum { LANES = 8 };                              /* motions at once, for the vector unit */
enum { L, R_O, M_ROD, I_E, D_E, A_E, GRAVITY };  /* parameters of a plant */
enum { ALPHA_A, LAMBDA_A, ALPHA_U, LAMBDA_U, ETA, LAYER };

/* What became of a motion. */
enum { HOME = 0, LATE = 1, SINGULAR = 2, LEFT = 3, LIMITED = 4 };

typedef double lanes[LANES];

struct task {
    double known[7];  /* the parameters that the law knows */
    double law[6];
    double limit;     /* of |u|, infinite for none */
    double period;    /* s, 0: the law is renewed at every instant */
    int64_t parts;    /* steps of a period */
    double step;      /* s, if it is */
    double duration;  /* s */
    double home;      /* |x| at which a motion has arrived; with a set, |W z| against its radius */
    double W[16];     /* with a set: of x, or of (q, p, s) if the law is held */
    double radius;    /* 0: no set */
};

static inline double least(double a, double b)
{
    return a < b ? a : b;
}

static inline double most(double a, double b)
{
    return a > b ? a : b;
}

/* Taylor sums for |a| ≤ 1.7, to the last digit or so: beyond, the motion is lost anyway. */
static void waves(const double *a, double *s, double *c)
{
    static const double by_sine[] = {6, 20, 42, 72, 110, 156, 210, 272, 342, 420};
    static const double by_cosine[] = {2, 12, 30, 56, 90, 132, 182, 240, 306, 380};
    lanes x, t;
    for (int i = 0; i < LANES; i++) {
        x[i] = least(most(a[i], -1.7), 1.7);
        t[i] = x[i] * x[i];
        s[i] = c[i] = 1.0;
    }
    for (int k = 9; k >= 0; k--) {
        double p = 1.0 / by_sine[k], q = 1.0 / by_cosine[k];
        for (int i = 0; i < LANES; i++) {
            s[i] = 1.0 - s[i] * t[i] * p;
            c[i] = 1.0 - c[i] * t[i] * q;
        }
    }
    for (int i = 0; i < LANES; i++)
        s[i] *= x[i];
}

/* The numbers of a plant that its equations have: a = I + m r², b = m l r, c = 4/3 m l², d = m g l,
 * the damping, the motor. */
struct body {
    lanes a, b, c, d, damping, motor, by_c, by_motor;
};

static void put(struct body *body, int i, const double *p)
{
    body->a[i] = p[I_E] + p[M_ROD] * p[R_O] * p[R_O];
    body->b[i] = p[M_ROD] * p[L] * p[R_O];
    body->c[i] = 4.0 / 3.0 * p[M_ROD] * p[L] * p[L];
    body->d[i] = p[M_ROD] * p[GRAVITY] * p[L];
    body->damping[i] = p[D_E];
    body->motor[i] = p[A_E];
    body->by_c[i] = 1.0 / body->c[i];
    body->by_motor[i] = 1.0 / p[A_E];
}

/* (a + c sin²φ) θ̈ − b cos φ φ̈ = f_a + motor u,  −b cos φ θ̈ + c φ̈ = f_u */
static void rates(const struct body *w, const lanes *x, const double *s, const double *c,
                  const double *u, const lanes *g, lanes *out)
{
    for (int i = 0; i < LANES; i++) {
        double v = x[2][i], r = x[3][i];
        double first = g[0][i] + w->motor[i] * u[i] - w->damping[i] * v
                       - 2.0 * w->c[i] * s[i] * c[i] * r * v - w->b[i] * s[i] * r * r;
        double second = g[1][i] + w->c[i] * s[i] * c[i] * v * v + w->d[i] * s[i];
        double aa = w->a[i] + w->c[i] * s[i] * s[i], au = -w->b[i] * c[i], uu = w->c[i];
        double once = 1.0 / (aa * uu - au * au);
        out[0][i] = v;
        out[1][i] = r;
        out[2][i] = (uu * first - au * second) * once;
        out[3][i] = (aa * second - au * first) * once;
    }
}

/* The law: the input demanded, s, and α_a − α_u M_au/M_uu, which must keep its sign. */
static void demands(const struct body *w, const double *k, const lanes *x, const double *s,
                    const double *c, double *demand, double *surface, double *gamma)
{
    double by_layer = 1.0 / k[LAYER];
    for (int i = 0; i < LANES; i++) {
        double v = x[2][i], r = x[3][i];
        double sum = k[ALPHA_A] * v + k[LAMBDA_A] * x[0][i] + k[ALPHA_U] * r + k[LAMBDA_U] * x[1][i];
        double push = k[ETA] * least(most(sum * by_layer, -1.0), 1.0);
        double wanted = -push - k[LAMBDA_A] * v - k[LAMBDA_U] * r; /* α_a θ̈ + α_u φ̈ */
        double second = w->c[i] * s[i] * c[i] * v * v + w->d[i] * s[i];
        double turn = w->b[i] * c[i] * w->by_c[i], slope = k[ALPHA_A] + k[ALPHA_U] * turn;
        double arm = (wanted - k[ALPHA_U] * second * w->by_c[i]) / slope;
        double rod = second * w->by_c[i] + turn * arm;
        double force = (w->a[i] + w->c[i] * s[i] * s[i]) * arm - w->b[i] * c[i] * rod
                       + w->damping[i] * v + 2.0 * w->c[i] * s[i] * c[i] * r * v
                       + w->b[i] * s[i] * r * r;
        demand[i] = force * w->by_motor[i];
        surface[i] = sum;
        gamma[i] = slope;
    }
}

static void step(const struct body *plant, const struct body *known, const struct task *t,
                 lanes *x, double *u, const lanes *g, double h)
{
    static const double at[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    lanes y[4], k[4], sum[4], s, c, surface, gamma;
    for (int stage = 0; stage < 4; stage++) {
        for (int j = 0; j < 4; j++)
            for (int i = 0; i < LANES; i++)
                y[j][i] = x[j][i] + (stage ? at[stage] * h * k[j][i] : 0.0);
        waves(y[1], s, c);
        if (t->period == 0.0) {
            demands(known, t->law, (const lanes *)y, s, c, u, surface, gamma);
            for (int i = 0; i < LANES; i++)
                u[i] = least(most(u[i], -t->limit), t->limit);
        }
        rates(plant, (const lanes *)y, s, c, u, g, k);
        for (int j = 0; j < 4; j++)
            for (int i = 0; i < LANES; i++)
                sum[j][i] = (stage ? sum[j][i] : 0.0) + weight[stage] * k[j][i];
    }
    for (int j = 0; j < 4; j++)
        for (int i = 0; i < LANES; i++)
            x[j][i] += h / 6.0 * sum[j][i];
}

/* |W z| for z = x, or z = (q, M_ua v_a + M_uu v_u, s), of one lane. */
static double level(const struct task *t, const struct body *w, const lanes *x, double s, int i)
{
    double total = 0.0, z[4] = {x[0][i], x[1][i], x[2][i], x[3][i]};
    if (t->period > 0.0) {
        z[2] = w->c[i] * x[3][i] - w->b[i] * cos(x[1][i]) * x[2][i];
        z[3] = s;
    }
    for (int row = 0; row < 4; row++) {
        double part = 0.0;
        for (int j = 0; j < 4; j++)
            part += t->W[4 * row + j] * z[j];
        total += part * part;
    }
    return sqrt(total);
}

/* Move count states (count, 4) on, each with its plant (count, 7) and its force (count, 2), until
 * they have arrived, are late, or did what is claimed not to happen: outcomes, and times in s. */
void follow(const struct task *t, int64_t count, double *states, const double *plants,
            const double *forces, int64_t *outcomes, double *times)
{
    struct body known, plant;
    lanes x[4], g[2], u, s, gamma, sine, cosine, sign = {0}, lowest = {0};
    int64_t index[LANES], next = 0, busy = 0;
    double age[LANES];
    for (int i = 0; i < LANES; i++) {
        put(&known, i, t->known);
        index[i] = -1;
    }
    for (;;) {
        for (int i = 0; i < LANES; i++) {  /* take up new motions */
            if (index[i] >= 0)
                continue;
            int64_t k = next < count ? next++ : -1, of = k < 0 ? 0 : k;
            index[i] = k;
            busy += k >= 0;
            put(&plant, i, plants + 7 * of);
            for (int j = 0; j < 4; j++)
                x[j][i] = k < 0 ? 0.0 : states[4 * k + j];
            for (int j = 0; j < 2; j++)
                g[j][i] = forces[2 * of + j];
            age[i] = sign[i] = 0.0;
            lowest[i] = INFINITY;
        }
        if (busy == 0)
            return;
        waves(x[1], sine, cosine);
        demands(&known, t->law, (const lanes *)x, sine, cosine, u, s, gamma);
        for (int i = 0; i < LANES; i++) {  /* what has happened to each */
            int64_t k = index[i], what = -1;
            if (k < 0)
                continue;
            double size = 0.0;
            for (int j = 0; j < 4; j++)
                size += x[j][i] * x[j][i];
            size = sqrt(size);
            if (sign[i] == 0.0)
                sign[i] = gamma[i];
            if (!(size < 1e4) || !(gamma[i] * sign[i] > 0.0) || !(fabs(x[1][i]) < 1.57))
                what = SINGULAR;
            else if (t->radius > 0.0) {
                double now = level(t, &plant, (const lanes *)x, s[i], i);
                if (now > lowest[i] * (1.0 + 1e-9) || now > t->radius * (1.0 + 1e-9))
                    what = LEFT;
                else if (fabs(s[i]) > t->law[LAYER] || fabs(u[i]) > t->limit)
                    what = LIMITED;
                else if (now < t->home * t->radius)
                    what = HOME;
                lowest[i] = now;
            } else if (size < t->home)
                what = HOME;
            if (what < 0 && age[i] >= t->duration)
                what = LATE;
            if (what < 0)
                continue;
            outcomes[k] = what;
            times[k] = age[i];
            for (int j = 0; j < 4; j++)
                states[4 * k + j] = x[j][i];
            index[i] = -1;
            busy--;
        }
        for (int i = 0; i < LANES; i++) {
            u[i] = least(most(u[i], -t->limit), t->limit);
            age[i] += t->period > 0.0 ? t->period : t->step;
        }
        if (t->period > 0.0)
            for (int64_t part = 0; part < t->parts; part++)
                step(&plant, &known, t, x, u, (const lanes *)g, t->period / (double)t->parts);
        else
            step(&plant, &known, t, x, u, (const lanes *)g, t->step);
    }
}

/* q̈ (2) at one state under an input, for the test that this is the plant of a file. */
void accelerations(const double *p, const double *state, double input, double *out)
{
    struct body plant;
    lanes x[4], g[2] = {{0}}, u, s, c, found[4];
    for (int i = 0; i < LANES; i++) {
        put(&plant, i, p);
        for (int j = 0; j < 4; j++)
            x[j][i] = state[j];
        u[i] = input;
    }
    waves(x[1], s, c);
    rates(&plant, (const lanes *)x, s, c, u, (const lanes *)g, found);
    out[0] = found[2][0];
    out[1] = found[3][0];
}
