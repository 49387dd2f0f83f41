// Regions on the surface (format page, 5.5): quadratic Taylor models, and boxes of them.
#pragma once
#include "document.hpp"
#include <array>

// c + Σ g_i ε_i + Σ_{i<=j} h_ij ε_i ε_j ± e over |ε_i| <= 1. The processor rounds up, so that e, a sum
// of numbers >= 0, is an upper bound as it is computed; a coefficient is a sum of at most 4 products,
// wrong by less than ROUND times the magnitudes of the factors, TINY if it underflows.
struct Quadratic {
    static constexpr double ROUND = 4e-15, TINY = 1e-300;
    static inline size_t V = 0;  // variables, at most 8
    double c = 0, e = 0, n = 0, m = 0;  // n, m: sums of |g| and |h|
    std::array<double, 8> g{};
    std::array<double, 36> h{};

    Quadratic() = default;
    Quadratic(double x) : c(x) {}
    explicit Quadratic(const Interval& x) : c(x.high), e(x.width()) {}
    static Quadratic constant(const Fraction& x) { return Quadratic(Interval(x)); }
    static Quadratic pi() { return Quadratic(Interval::pi()); }
    static Quadratic undefined() { return Quadratic(Interval::undefined()); }
    static Quadratic variable(const Interval& side, size_t i) {
        Quadratic r;
        r.c = side.low() / 2 + side.high / 2;
        r.g[i] = r.n = std::max(side.high - r.c, r.c + side.minus);
        r.e = TINY;
        return r;
    }
    static size_t pairs() { return V * (V + 1) / 2; }
    double reach() const { return n + m + e; }
    double all() const { return std::fabs(c) + n + m; }
    Quadratic summed() const {  // with n and m
        Quadratic r = *this;
        r.n = r.m = 0;
        for (size_t i = 0; i < V; ++i) r.n += std::fabs(g[i]);
        for (size_t k = 0; k < pairs(); ++k) r.m += std::fabs(h[k]);
        return r;
    }
    Interval range() const {
        double high = c, minus = -c;
        for (size_t i = 0, k = 0; i < V; ++i) {
            const double a = std::fabs(g[i]), q = h[k++];
            // the most of ± a t + q t² for |t| <= 1
            high += 2 * q < -a ? a * (a / (-4 * q)) : a + q;
            minus += 2 * q > a ? a * (a / (4 * q)) : a - q;
            for (size_t j = i + 1; j < V; ++j, ++k) high += std::fabs(h[k]), minus += std::fabs(h[k]);
        }
        const double rest = e + ROUND * all() + TINY;
        return Interval::ends(minus + rest, high + rest);
    }
};
inline Quadratic combined(const Quadratic& a, const Quadratic& b, double by) {  // a + by · b, by = ±1
    Quadratic r;
    r.c = a.c + by * b.c;
    for (size_t i = 0; i < Quadratic::V; ++i) r.g[i] = a.g[i] + by * b.g[i];
    for (size_t k = 0; k < Quadratic::pairs(); ++k) r.h[k] = a.h[k] + by * b.h[k];
    r = r.summed();
    r.e = a.e + b.e + Quadratic::ROUND * r.all() + Quadratic::TINY;
    return r;
}
inline Quadratic operator+(const Quadratic& a, const Quadratic& b) { return combined(a, b, 1); }
inline Quadratic operator-(const Quadratic& a, const Quadratic& b) { return combined(a, b, -1); }
inline Quadratic operator-(Quadratic a) {
    a.c = -a.c;
    for (double& x : a.g) x = -x;
    for (double& x : a.h) x = -x;
    return a;
}
inline Quadratic operator*(const Quadratic& a, const Quadratic& b) {
    Quadratic r;
    r.c = a.c * b.c;
    for (size_t i = 0, k = 0; i < Quadratic::V; ++i) {
        r.g[i] = a.c * b.g[i] + a.g[i] * b.c;
        r.h[k] = a.c * b.h[k] + a.h[k] * b.c + a.g[i] * b.g[i];
        ++k;
        for (size_t j = i + 1; j < Quadratic::V; ++j, ++k)
            r.h[k] = a.c * b.h[k] + a.h[k] * b.c + a.g[i] * b.g[j] + a.g[j] * b.g[i];
    }
    r = r.summed();
    r.e = a.n * b.m + a.m * b.n + a.m * b.m + a.e * (b.all() + b.e) + b.e * a.all() +
          Quadratic::ROUND * (a.all() * b.all()) + Quadratic::TINY;
    return r;
}
inline bool is_zero(const Quadratic&) { return false; }

// f(a) from f, f' and f''/2 at the middle, and a bound of |f'''|/6 over all of it.
inline Quadratic composed(const Quadratic& a, const Interval& f0, const Interval& f1, const Interval& f2, double third) {
    const auto middle = [](const Interval& x) { return x.low() / 2 + x.high / 2; };
    const double p = middle(f0), s = middle(f1), t = middle(f2), r = a.reach();
    double off = 0;
    for (const Interval& x : {f0, f1, f2}) off += x.width();
    Quadratic out;
    out.c = p;
    for (size_t i = 0, k = 0; i < Quadratic::V; ++i) {
        out.g[i] = s * a.g[i];
        for (size_t j = i; j < Quadratic::V; ++j, ++k) out.h[k] = s * a.h[k] + (i == j ? t : 2 * t) * (a.g[i] * a.g[j]);
    }
    out = out.summed();
    const double size = std::fabs(s), curve = std::fabs(t);
    const double square = 2 * a.n * a.m + a.m * a.m + (2 * (a.n + a.m) + a.e) * a.e;
    out.e = size * a.e + curve * square + third * r * r * r + off * (1 + r + r * r) +
            Quadratic::ROUND * (std::fabs(p) + size * r + curve * r * r) + Quadratic::TINY;
    return out;
}
inline Interval spread(const Quadratic& a) { return Interval::ends(a.reach() - a.c, a.c + a.reach()); }
inline Quadratic operator/(const Quadratic& a, const Quadratic& b) {
    const Interval w = Interval(1.0) / Interval(b.c), over = Interval(1.0) / spread(b);
    return a * composed(b, w, -(w * w), w * w * w, power(over, 4).size());
}
inline Quadratic power(const Quadratic& a, int k) { return k == 0 ? Quadratic(1.0) : k == 1 ? a : a * power(a, k - 1); }
inline Quadratic root(const Quadratic& a) {
    const Interval x(a.c), f = root(x), all = spread(a), one(1.0);
    return composed(a, f, one / (Interval(2.0) * f), -(one / (Interval(8.0) * x * f)),
                    (one / (Interval(16.0) * all * all * root(all))).size());
}
inline Quadratic exponential(const Quadratic& a) {
    const Interval f = exponential(Interval(a.c));
    return composed(a, f, f, f / Interval(2.0), (exponential(spread(a)) / Interval(6.0)).size());
}
inline Quadratic logarithm(const Quadratic& a) {
    const Interval w = Interval(1.0) / Interval(a.c), over = Interval(1.0) / spread(a);
    return composed(a, logarithm(Interval(a.c)), w, -(w * w / Interval(2.0)),
                    positive(spread(a)) ? (power(over, 3) / Interval(3.0)).size() : NOT);
}
inline Quadratic tanh_of(const Quadratic& a) {  // |tanh'''| <= 2
    const Interval f = tanh_of(Interval(a.c)), s = Interval(1.0) - f * f;
    return composed(a, f, s, -(f * s), 0.34);
}
inline Quadratic wave(const Quadratic& a, int quarter) {
    static double last = NOT;  // sin and cos of one number are asked for again and again
    static Interval sine, cosine;
    if (!(a.c == last)) last = a.c, sine = wave(Interval(a.c), 0), cosine = wave(Interval(a.c), 1);
    const Interval f = quarter ? cosine : sine, s = quarter ? -sine : cosine;
    return composed(a, f, s, -(f / Interval(2.0)), 0.17);
}

// ---- The claim -------------------------------------------------------------------------------------

struct Stretch {
    std::vector<Matrix<Fraction>> S;
    Fraction pole{0};
    Fraction first(const Fraction& q) const {  // c_0 at y_0 = q
        Fraction tau = S.empty() ? Fraction(0) : q * q / (pole * pole - q * q), sum(1), by(1);
        for (const auto& s : S) by = by * tau, sum = sum + s[0][0] * by;
        return q * sum;
    }
};
struct Lyapunov {
    Matrix<Fraction> A, G;
    std::vector<std::pair<std::vector<int>, Fraction>> terms;  // the largest exponents first
    Lyapunov(const Json& j, size_t N) {
        only_keys(j, {"A", "G", "exponents", "coefficients"}, "function");
        A = fraction_matrix(j.keys.at("A"), N, N, "A");
        G = fraction_matrix(j.keys.at("G"), N, N, "G");
        for (size_t i = 0; i < N; ++i)
            for (size_t k = i; k < N; ++k)
                if ((k == i) == (G[i][k].sign() == 0)) refuse("G is not lower triangular, or has a 0 in its diagonal");
        const auto& rows = list(j.keys.at("exponents"), 1, 5000, "exponents");
        const auto values = fractions(j.keys.at("coefficients"), rows.size(), "coefficients");
        for (size_t k = 0; k < rows.size(); ++k) {
            std::vector<int> e;
            int total = 0;
            for (const Json& v : list(rows[k], N, N, "exponents")) total += e.emplace_back(int(index_below(v, 25, "exponent")));
            if (total < 2 || total % 2) refuse("exponents of an odd sum, or 0");
            terms.push_back({e, values[k]});
        }
        std::sort(terms.begin(), terms.end(), [](const auto& a, const auto& b) { return a.first > b.first; });
        for (size_t k = 1; k < terms.size(); ++k)
            if (terms[k].first == terms[k - 1].first) refuse("exponents that occur twice");
    }
};
struct SurfaceRegion {
    size_t N;
    Stretch stretch;
    std::vector<Lyapunov> functions;
    std::vector<Fraction> contains;
    std::vector<std::pair<size_t, std::pair<Fraction, Fraction>>> plant;  // parameter, ends

    SurfaceRegion(const Json& j, const Model& model) : N(2 * model.n - model.m) {
        only_keys(j, {"kind", "stretch", "pole", "functions", "contains", "plant"}, "claim", true);
        for (const Json& s : list(j.keys.at("stretch"), 0, 12, "stretch")) {
            stretch.S.push_back(fraction_matrix(s, N, N, "stretch"));
            for (size_t k = 0; k < N; ++k) {
                const int sign = stretch.S.back()[0][k].sign();
                if (k ? sign != 0 : sign < 0) refuse("a first row of a stretch that is not (>= 0, 0, ...)");
            }
        }
        if (stretch.S.empty() != (j.keys.at("pole").kind == Json::null)) refuse("a pole without a stretch, or none with one");
        if (!stretch.S.empty()) stretch.pole = fraction(j.keys.at("pole"), 1);
        for (const Json& f : list(j.keys.at("functions"), 1, 200, "functions")) functions.emplace_back(f, N);
        contains = fractions(j.keys.at("contains"), N, "contains");
        const Fraction size = contains[0].sign() < 0 ? -contains[0] : contains[0];
        if (!stretch.S.empty() && !(size < stretch.pole)) refuse("what is contained is beyond the pole");
        for (const auto& [key, value] : of_kind(j.keys.at("plant"), Json::object, "plant").keys) {
            const auto at = std::find(model.parameter_names.begin(), model.parameter_names.end(), key);
            if (at == model.parameter_names.end()) refuse("a plant names something that is no parameter");
            const size_t k = size_t(at - model.parameter_names.begin());
            const auto ends = fractions(value, 2, "plant");
            if (!(ends[0] <= model.parameters[k] && model.parameters[k] <= ends[1])) refuse("a plant without the model's own parameter");
            plant.push_back({k, {ends[0], ends[1]}});
        }
    }
};

// A x = b by elimination without exchanges: undefined where a pivot may be 0.
template <class X> std::vector<X> solved(Matrix<X> A, std::vector<X> b) {
    for (size_t k = 0; k < b.size(); ++k)
        for (size_t i = k + 1; i < b.size(); ++i) {
            const X by = A[i][k] / A[k][k];
            for (size_t j = k; j < b.size(); ++j) A[i][j] = A[i][j] - by * A[k][j];
            b[i] = b[i] - by * b[k];
        }
    for (size_t i = b.size(); i-- > 0;) {
        for (size_t j = i + 1; j < b.size(); ++j) b[i] = b[i] - A[i][j] * b[j];
        b[i] = b[i] / A[i][i];
    }
    return b;
}

// Everything of one function in one arithmetic, its numbers enclosed once.
template <class T> struct Surface {
    using X = Jet<T>;
    const Model& model;
    const SurfaceRegion& claim;
    std::vector<X> leaves;
    Matrix<X> lambda_a, ratio, alpha, alpha_u;  // ratio = λ_a⁻¹ λ_u, alpha = α_a⁻¹
    std::vector<Matrix<X>> S;
    X square;  // L²

    struct Function {
        const Lyapunov& of;
        Matrix<X> A, G;
        std::vector<X> coefficients;
        explicit Function(const Lyapunov& f) : of(f), A(constants<T>(f.A)), G(constants<T>(f.G)) {
            for (const auto& term : f.terms) coefficients.push_back(X(T::constant(term.second)));
        }
        // Σ c Π z^e over terms [from, to), from variable i on, and its rate for z that move at dz, if any
        std::pair<X, X> along(const std::vector<X>& z, const std::vector<X>& dz, size_t from, size_t to, size_t i = 0) const {
            if (i == z.size()) return {coefficients[from], X()};
            std::pair<X, X> r;
            bool begun = false;
            for (int power = of.terms[from].first[i]; power >= 0; --power) {
                if (begun) r = {r.first * z[i], dz.empty() ? X() : r.second * z[i] + r.first * dz[i]};
                const size_t start = from;
                while (from < to && of.terms[from].first[i] == power) ++from;
                if (start == from) continue;
                const auto part = along(z, dz, start, from, i + 1);
                r = begun ? std::make_pair(r.first + part.first, dz.empty() ? X() : r.second + part.second) : part;
                begun = true;
            }
            return r;
        }
        std::pair<X, X> value(const std::vector<X>& z, const std::vector<X>& dz = {}) const { return along(z, dz, 0, of.terms.size()); }
        X guard(const std::vector<X>& c) const {
            X r;
            for (const X& v : product(G, c)) r = r + v * v;
            return r;
        }
    };

    Surface(const Model& own, const Law& law, const SurfaceRegion& region)
        : model(own), claim(region), leaves(leaves_of<T>(own.nodes, own.needed, own.parameters)),
          lambda_a(constants<T>(law.lambda_a)), ratio(inverse_times(lambda_a, constants<T>(law.lambda_u))),
          alpha(inverse(constants<T>(law.alpha_a))), alpha_u(constants<T>(law.alpha_u)),
          square(T::constant(region.stretch.pole * region.stretch.pole)) {
        for (const auto& s : region.stretch.S) S.push_back(constants<T>(s));
    }
    static Matrix<X> inverse_times(const Matrix<X>& a, const Matrix<X>& b) { return product(inverse(a), b); }

    // I + Σ τ^j S_j at y_0 = q, and its derivative by q
    std::pair<Matrix<X>, Matrix<X>> bend(const X& q) const {
        const size_t N = claim.N;
        Matrix<X> total(N, std::vector<X>(N)), slope = total;
        for (size_t i = 0; i < N; ++i) total[i][i] = X(T(1.0));
        if (S.empty()) return {total, slope};
        const X w = X(T(1.0)) / (square - q * q), tau = q * q * w, rate = X(T(2.0)) * q * square * w * w;
        X by(T(1.0));
        for (size_t j = 0; j < S.size(); ++j) {
            const X d = X(T(double(j + 1))) * by * rate;
            by = by * tau;
            for (size_t i = 0; i < N; ++i)
                for (size_t k = 0; k < N; ++k) {
                    if (claim.stretch.S[j][i][k].sign() == 0) continue;
                    total[i][k] = total[i][k] + S[j][i][k] * by;
                    slope[i][k] = slope[i][k] + S[j][i][k] * d;
                }
        }
        return {total, slope};
    }
    // ẏ and the pivots of M at y; p in the order of the claim's plant
    std::vector<X> rates(const std::vector<X>& y, const std::vector<X>& p, std::vector<X>& pivots) const {
        const size_t n = model.n, m = model.m, u = n - m;
        using Vector = std::vector<X>;
        const auto plus = [](Vector a, const Vector& b, double sign) {
            for (size_t i = 0; i < a.size(); ++i) a[i] = sign < 0 ? a[i] - b[i] : a[i] + b[i];
            return a;
        };
        const Vector qu(y.begin(), y.begin() + long(u)), vu(y.begin() + long(u), y.begin() + long(2 * u)), w(y.begin() + long(2 * u), y.end());
        Vector q = plus(w, product(ratio, qu), -1), v = product(alpha, plus(product(lambda_a, w), product(alpha_u, vu), 1));
        for (X& x : v) x = -x;
        const Vector w_dot = plus(v, product(ratio, vu), 1);
        q.insert(q.end(), qu.begin(), qu.end());
        v.insert(v.end(), vu.begin(), vu.end());
        auto known = leaves;
        for (size_t i = 0; i < model.nodes.size(); ++i)
            for (size_t k = 0; k < p.size(); ++k)
                if (model.nodes[i].op == Op::parameter && model.nodes[i].a == claim.plant[k].first) known[i] = p[k];
        const Plant<T> plant = model.template at<T>(q, v, true, &known);
        Matrix<X> R(n, Vector(n));
        const auto place = [&](size_t i) { return i < u ? m + i : i - u; };
        for (size_t i = 0; i < n; ++i)
            for (size_t j = 0; j < n; ++j) R[i][j] = plant.M[place(i)][place(j)];
        for (size_t k = 0; k < n; ++k) {
            pivots.push_back(R[k][k]);
            for (size_t i = k + 1; i < n; ++i) {
                const X by = R[i][k] / R[k][k];
                for (size_t j = k; j < n; ++j) R[i][j] = R[i][j] - by * R[k][j];
            }
        }
        Matrix<X> M_ua(u), E(u);
        for (size_t i = 0; i < u; ++i) {
            M_ua[i].assign(plant.M[m + i].begin(), plant.M[m + i].begin() + long(m));
            E[i].assign(plant.M[m + i].begin() + long(m), plant.M[m + i].end());
        }
        const auto pull = product(M_ua, alpha);
        E = sum(E, product(pull, alpha_u), true);
        const Vector fu(plant.f.begin() + long(m), plant.f.end());
        const Vector a = solved(E, plus(fu, product(pull, product(lambda_a, w_dot)), 1));
        Vector r = vu;
        r.insert(r.end(), a.begin(), a.end());
        r.insert(r.end(), w_dot.begin(), w_dot.end());
        return r;
    }
    struct At {
        std::vector<X> c, z, dz, y, pivots;
    };
    // at x, the coordinates of the boxes of a function
    At at(const Function& V, const X& chord, const std::vector<X>& x, const std::vector<X>& p) const {
        const size_t N = claim.N;
        At r;
        const auto [total, slope] = bend(x[0]);
        r.c.push_back(total[0][0] * x[0]);
        for (size_t i = 1; i < N; ++i) {
            X own = x[i] - V.G[i][0] * chord * x[0];
            for (size_t j = 1; j < i; ++j) own = own - V.G[i][j] * r.c[j];
            r.c.push_back(own / V.G[i][i]);
        }
        Matrix<X> rest;
        std::vector<X> right;
        for (size_t i = 1; i < N; ++i) {
            rest.emplace_back(total[i].begin() + 1, total[i].end());
            right.push_back(r.c[i] - total[i][0] * x[0]);
        }
        r.y = solved(rest, right);
        r.y.insert(r.y.begin(), x[0]);
        const auto y_dot = rates(r.y, p, r.pivots);
        auto c_dot = product(total, y_dot);
        const auto bent = product(slope, r.y);
        for (size_t i = 0; i < N; ++i) c_dot[i] = c_dot[i] + bent[i] * y_dot[0];
        r.z = product(V.A, r.c);
        r.dz = product(V.A, c_dot);
        return r;
    }
};
