static const ut_real ut_gain[UT_X][UT_N] = {
${gains}
};

/* The accelerations of the model. */
static void ut_model(const ut_real x[UT_X], const ut_real u[UT_M], ut_real rate[UT_N])
{
${step}
}

static void ut_estimate(ut_controller *c, const ut_real q[UT_N])
{
    ut_real ahead[UT_X];
    ut_real rate[UT_N];
    int good = 1;
    for (int i = 0; i < UT_N; i++) {
        if (!c->running) {
            c->x[i] = q[i];
            c->x[UT_N + i] = 0;
        }
    }
    ut_model(c->x, c->u, rate);
    for (int i = 0; i < UT_N; i++) {
        const ut_real v = c->x[UT_N + i];
        ahead[i] = c->x[i] + UT_PERIOD * (v + ${half} * UT_PERIOD * rate[i]);
        ahead[UT_N + i] = v + UT_PERIOD * rate[i];
    }
    for (int i = 0; i < UT_X; i++) {
        c->x[i] = ahead[i];
        for (int k = 0; k < UT_N; k++) {
            c->x[i] += ut_gain[i][k] * (q[k] - ahead[k]);
        }
        good &= ut_sound(c->x[i]);
    }
    for (int i = 0; i < UT_N; i++) {
        if (!good) {
            c->x[i] = q[i];
            c->x[UT_N + i] = 0;
        }
    }
}
